"""The table of control by columns: what each frozen planner leaves of the distance, model by model.

It is made of entries whose control was planned by a column (``dmotion_bench/planning/columns.py``). Each says what one
training leaves on each task. Intervals are over tasks and trainings; shares of solved tasks have Wilson's.

Rows are comparable where they are over the same tasks and steps. Those over others than most trainings stand below
them, with their number of tasks and steps, so that no entry hides the row of another one.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.figures import SUCCESS
from dmotion_bench.scoring.statistics import Estimate, wilson
from dmotion_bench.scoring.trainings import DETECTED, detectable_difference, over_trainings
from leaderboard.columns import control_steps
from leaderboard.comparison import PARTS
from leaderboard.control import PUBLISHED
from leaderboard.entry import Entry
from leaderboard.extent import LOST, SUCCEEDED, Extent, is_whole
from leaderboard.row import Row
from leaderboard.run_names import training_data_of, training_of, unusual_settings, without_seed
from leaderboard.usual import most_common, shared_figures
from leaderboard.value import Value

SOLVED_AT: Final = SUCCESS
ORACLE: Final = "oracle"
"""The reference that plans."""
_OF_A_TRAINING: Final = ("seed", "weights")
"""What tells the trainings of a row apart: each of them."""
RowKey = tuple[str, str, str]
"""Model, variant and label budget."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What one column's planner leaves with one model.

    Attributes:
        left: The mean distance at the end, with its interval over tasks and trainings.
        solved: The share of tasks that are solved, and Wilson's interval for so many tasks.
        lost: Objects lost, mean over tasks.
        tasks, trainings: How many there are.
        after: The mean distance by the number of steps, as far as all trainings have it.
        sums, counts: Of each training each episode's sum of distances, and each episode's number of tasks; None of
            references.
    """

    left: Estimate
    solved: tuple[float, float, float]
    lost: float
    tasks: int
    trainings: int
    after: Mapping[int, float]
    sums: Float[np.ndarray, "k e"] | None = None
    counts: Float[np.ndarray, " e"] | None = None


@dataclass(frozen=True, kw_only=True)
class ColumnRow:
    """A model, or a reference.

    Attributes:
        name, variant, labels: What it is called, what tells it from others, its label budget.
        extent: Its tasks and steps in words, where these are not the table's; empty of rows that are compared.
        label_count: What the budget came to.
        cells: By the columns' names.
        entries: Behind it; none of a reference.
    """

    name: str
    variant: str = ""
    labels: str = ""
    extent: str = ""
    label_count: int | None = None
    cells: Mapping[str, Outcome]
    entries: tuple[Entry, ...] = ()

    @property
    def small(self) -> str:
        """What tells it from others of its name, in one."""
        return ", ".join(part for part in (self.variant, self.extent) if part)

    @property
    def title(self) -> str:
        """Its name, its variant and other tasks or steps."""
        return f"{self.name} ({self.small})" if self.small else self.name

    @property
    def key(self) -> RowKey:
        """By which the same model is found on the board."""
        return self.name, self.variant, self.labels


@dataclass(frozen=True, kw_only=True)
class ColumnTable:
    """The table of one data set's tasks.

    Attributes:
        dataset, fingerprint: Of the data set.
        columns: Names of those that there are figures of, in their order.
        rows: The best of the first column first, then those over other tasks or steps, references last.
        steps: Of a task.
        made_by: Which other version of control it is of, in words; empty of this dmbench's.
        detectable: By column, the smallest difference between two models that the table can show, as a distance; of
            models with several trainings.
    """

    dataset: str
    fingerprint: str
    columns: tuple[str, ...]
    rows: tuple[ColumnRow, ...]
    steps: int
    made_by: str = ""
    detectable: Mapping[str, float]

    @property
    def compared(self) -> list[ColumnRow]:
        """The rows over the table's tasks and steps, references among them."""
        return [row for row in self.rows if not row.extent]

    @property
    def entries(self) -> list[Entry]:
        """All that it is made of."""
        return [entry for row in self.rows for entry in row.entries]


def column_table(entries: Sequence[Entry], words: Mapping[str, str], *, made_by: str = "") -> ColumnTable | None:
    """The table of some entries, all planned by columns of one version; None where nothing can be shown.

    It is of the tasks and steps of most trainings. Entries with another seed or more steps than a column has are left
    out.

    Args:
        entries: Those of one data set.
        words: What references are called.
        made_by: See ``ColumnTable``.
    """
    frozen = [(entry, Extent.of(entry)) for entry in entries if entry.column in COLUMNS and _is_frozen(entry)]
    known = [(entry, extent) for entry, extent in frozen if extent is not None]
    usual = most_common(sorted(known, key=lambda one: one[1].size, reverse=True))
    if usual is None:
        return None
    groups: dict[tuple[Any, ...], dict[str, list[Entry]]] = defaultdict(lambda: defaultdict(list))
    for entry, extent in known:
        groups[extent, *training_of(entry)][str(entry.column)].append(entry)
    firsts = [next(iter(by_column.values()))[0] for by_column in groups.values()]
    extents = [key[0] for key in groups]
    rows = [
        _row(key, by_column, extent, usual)
        for key, by_column, extent in zip(_keys(firsts, extents), groups.values(), extents, strict=True)
    ]
    columns = tuple(name for name in COLUMNS if any(name in row.cells for row in rows))
    far = float("inf")

    def place(row: ColumnRow) -> tuple[Any, ...]:
        left = (row.cells[name].left.mean if name in row.cells else far for name in columns)
        return bool(row.extent), row.extent, *left, row.key

    rows.sort(key=place)
    dataset, own = known[0][0].content["dataset"], [entry for entry, extent in known if extent == usual]
    return ColumnTable(
        dataset=dataset["name"],
        fingerprint=dataset["fingerprint"],
        columns=columns,
        rows=(*rows, *_references(own, columns, usual.figure, words)),
        steps=usual.steps,
        made_by=made_by,
        detectable={name: found for name in columns if (found := _detectable(rows, name)) is not None},
    )


def _is_frozen(entry: Entry) -> bool:
    """Whether an entry's control has the seed of every column, and not too many steps."""
    frozen = ControlScoring()
    return entry.content["settings"].get("control_seed", 0) == frozen.seed and 0 < _last(entry) <= frozen.steps


def _last(entry: Entry) -> int:
    return max(control_steps(entry.figures), default=0)


def _keys(entries: Sequence[Entry], extents: Sequence[Extent]) -> list[RowKey]:
    """Of entries of different trainings: model, variant and budget, different for all of one extent.

    The variant is how the labels were used, if not as usual, and what the run's name says beyond these, the preset and
    the seed. The number of threads is left out: of two results of a seed one counts. Where that is the same for several
    trainings, it also says what each was trained on, and for how long.
    """
    keys = [_key(entry) for entry in entries]
    often = Counter(zip(keys, extents, strict=True))
    told = [
        _key(entry, _origin(entry)) if often[key, extent] > 1 else key
        for entry, key, extent in zip(entries, keys, extents, strict=True)
    ]
    often = Counter(zip(told, extents, strict=True))  # data sets of one name
    return [
        _key(entry, _origin(entry), training_data_of(entry)["fingerprint"][:8]) if often[key, extent] > 1 else key
        for entry, key, extent in zip(entries, told, extents, strict=True)
    ]


def _key(entry: Entry, *more: str) -> RowKey:
    arch, settings = entry.content["arch"], unusual_settings(entry)
    parts = [f"{arch} architecture"] * (arch != "compact") + [entry.label_use, *more]
    parts.append(without_seed(entry) if settings is None else settings)
    return entry.model, ", ".join(part for part in parts if part), entry.labels


def _origin(entry: Entry) -> str:
    return f"trained on {training_data_of(entry)['name']}, preset {entry.content['preset']}"


def _row(key: RowKey, by_column: Mapping[str, Sequence[Entry]], extent: Extent, usual: Extent) -> ColumnRow:
    entries = [entry for own in by_column.values() for entry in own]
    name, variant, labels = key
    return ColumnRow(
        name=name,
        variant=variant,
        labels=labels,
        extent="" if extent == usual else extent.words,
        label_count=most_common((entry, entry.label_count) for entry in entries),
        cells={column: _cell(own, extent) for column, own in by_column.items()},
        entries=tuple(sorted(entries, key=lambda entry: (str(entry.column), entry.content["seed"], entry.slug))),
    )


def _cell(entries: Sequence[Entry], extent: Extent) -> Outcome:
    """The trainings with different seeds and weights; of two results of one training the first counts."""
    trained: list[Entry] = []
    for entry in sorted(entries, key=lambda entry: (entry.content["seed"], entry.slug)):
        if all(entry.content[name] != other.content[name] for other in trained for name in _OF_A_TRAINING):
            trained.append(entry)
    counts = np.asarray(extent.tasks.counts, np.float64)
    table = np.array([entry.by_episode[extent.figure]["sum"] for entry in trained], np.float64)
    tasks, _ = extent.size
    share = float(np.mean([entry.figures[SUCCEEDED]["mean"] for entry in trained]))
    return Outcome(
        left=over_trainings(table, counts),
        solved=(share, *wilson(share, tasks)),
        lost=float(np.mean([entry.figures[LOST]["mean"] for entry in trained])),
        tasks=tasks,
        trainings=len(trained),
        after=_after([entry.figures for entry in trained]),
        sums=table,
        counts=counts,
    )


def _after(trainings: Sequence[Mapping[str, Any]]) -> dict[int, float]:
    """The distance after each step, as the mean over some trainings that all have it."""
    named = {step: f"control_distance[{step}]" for step in control_steps(trainings[0])}
    means = {step: [figures.get(name, {}).get("mean") for figures in trainings] for step, name in named.items()}
    return {step: float(np.mean(own)) for step, own in means.items() if None not in own}


def _references(
    entries: Sequence[Entry], columns: Sequence[str], figure: str, words: Mapping[str, str]
) -> list[ColumnRow]:
    """The references beside the models; those that do not plan are the same in every column, the oracle is not.

    What was published was done by another planner, in other tasks.
    """
    found: dict[str, dict[str, Outcome]] = defaultdict(dict)
    for column in columns:
        said = [
            (entry, name, own)
            for entry in entries
            for name, own in entry.content["reference"].items()
            if name != PUBLISHED and is_whole(own, figure) and (name != ORACLE or entry.column == column)
        ]
        for name, figures in shared_figures(said).items():
            found[name][column] = _reference_cell(figures, figure)
    return [ColumnRow(name=words.get(name, name), cells=cells) for name, cells in found.items()]


def _reference_cell(figures: Mapping[str, Any], figure: str) -> Outcome:
    left, tasks = figures[figure], int(figures[figure]["n"])
    share = float(figures[SUCCEEDED]["mean"])
    return Outcome(
        left=Estimate(**{part: left[part] for part in PARTS} | {"std": float(left["std"] or 0)}),
        solved=(share, *wilson(share, tasks)),
        lost=float(figures[LOST]["mean"]),
        tasks=tasks,
        trainings=0,
        after=_after([figures]),
    )


def rows_of_column(table: ColumnTable, column: str) -> list[Row]:
    """The rows that a column has cells of, as a board has its other rows: their distances after each step."""
    found = [(row, row.cells[column]) for row in table.compared if column in row.cells]
    return [
        Row(
            kind="measured" if row.entries else "reference",
            name=row.name,
            model=row.name if row.entries else "",
            variant=row.variant,
            labels=row.labels,
            label_count=row.label_count,
            entries=tuple(entry for entry in row.entries if entry.column == column),
            figures={f"control_distance[{step}]": _value(cell, step, table.steps) for step in cell.after},
        )
        for row, cell in found
    ]


def _value(cell: Outcome, step: int, last: int) -> Value:
    """The distance after a step; its interval is known at the end alone."""
    if step < last:
        return Value(mean=cell.after[step], low=None, high=None, std=None, seeds=cell.trainings, samples=cell.tasks)
    left = cell.left
    return Value(
        mean=left.mean,
        low=left.low,
        high=left.high,
        std=None,
        seeds=cell.trainings,
        interval=None if left.low is None or left.high is None else (left.low, left.high),
        samples=cell.tasks,
    )


def detectable_words(table: ColumnTable, written: Callable[[float], str]) -> str:
    """Of each column, which difference the table can show, in words; empty of single trainings.

    Args:
        table: The table.
        written: How a number is written.
    """
    return " ".join(
        f"{COLUMNS[name].title}: the table shows a true difference of {written(one)} between two models in "
        f"{DETECTED:.0%} of cases, a smaller one less often."
        for name, one in table.detectable.items()
    )


def _detectable(rows: Sequence[ColumnRow], column: str) -> float | None:
    """From all pairs of models with several trainings on the same episodes."""
    measured = [
        (cell.sums, cell.counts)
        for row in rows
        if not row.extent
        and (cell := row.cells.get(column)) is not None
        and cell.sums is not None
        and cell.counts is not None
        and len(cell.sums) > 1  # one training says nothing of what differs between trainings
    ]
    return detectable_difference(
        (one, other, counts)
        for (one, counts), (other, others) in itertools.combinations(measured, 2)
        if np.array_equal(counts, others)
    )
