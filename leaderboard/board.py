"""Boards from entries: one board per data set, one row per model, architecture and label budget.

Runs that differ in nothing but their seed are one row. Its value is the mean over these trainings; beside it stand
their range and the 95% interval over test episodes and trainings. Who is better is not read from these: each row is
compared with the best by the paired difference (``comparison.py``), whose interval is over both, too.

Control is as good as the planner, so only what one planner did in the same tasks is averaged and compared: of those of
this dmbench's version, or, where nothing of it is there, of all, the one that planned most. Rows that have none of it
keep another's, marked. Rollouts and the gain captured that were measured with other settings than most are left out.
"""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, TypeVar

from dmotion_bench.planning.columns import HEADLINE
from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.registry import environment_title, environment_versions
from dmotion_bench.scoring.report import CONTRACT
from dmotion_bench.scoring.statistics import Estimate
from leaderboard.agreement import Agreement, agreements
from leaderboard.column_table import ColumnTable, column_table, rows_of_column
from leaderboard.columns import TRUE_MOTION, control_steps
from leaderboard.comparison import difference_by_episode
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.efficiency import beside_curves, label_curves
from leaderboard.entry import Entry, Planner
from leaderboard.row import Row
from leaderboard.run_names import settings_of, training_of, unusual_settings
from leaderboard.value import Value, values_of

RANKED_BY: Final = "mse"
OTHER_PLANNER: Final = "another planner"
"""Marks a row of control that is not compared."""
AGENT_MOVES: Final = "agent_moves"
ORACLE: Final = "oracle"
_T = TypeVar("_T")

REFERENCE_WORDS: Final = {
    "copy_last": "copy the last frame",
    AGENT_MOVES: "only the agent moves",
    "idle": "idle",
    "random": "random actions",
    ORACLE: "true simulator as the model",
    "scripted": "scripted pusher",
}


@dataclass(frozen=True, kw_only=True)
class Board:
    """The results on one data set.

    Attributes:
        environment: Registry name.
        version: Of the environment; data sets of two versions have two boards.
        dataset, fingerprint: Of the data set; empty where only published results are known.
        recording: The command that records the data set; empty where it is not known, or was no recording.
        split, protocol: Which episodes, and how triplets were split.
        triplets: Single steps that were scored; None where nothing was.
        rows: The best first, then the published rows and the references where their error puts them.
        control: The table of control by columns; None where nothing was scored for it.
        agreement: How well the gain captured agrees with other figures.
    """

    environment: str
    version: int = 1
    dataset: str = ""
    fingerprint: str = ""
    recording: str = ""
    split: str = ""
    protocol: str = ""
    triplets: int | None = None
    rows: tuple[Row, ...]
    control: ColumnTable | None = None
    agreement: tuple[Agreement, ...] = ()

    @property
    def title(self) -> str:
        """The environment in words, with the version of the data where the environment has several."""
        name = environment_title(self.environment)
        several = self.version > 1 or (self.fingerprint and environment_versions(self.environment))
        return f"{name}, version {self.version}" if several else name

    @property
    def measured(self) -> list[Entry]:
        """The entries that were measured here, without those of the table of control by columns."""
        return [entry for row in self.rows if row.kind == "measured" for entry in row.entries]

    @cached_property
    def label_curves(self) -> dict[tuple[str, str], list[Row]]:
        """The rows of each model and variant that was measured under several budgets, the last of them all labels."""
        return label_curves(self.rows, RANKED_BY)

    @cached_property
    def rows_beside_curves(self) -> list[Row]:
        """The rows without the points of label curves that have only a number for a budget."""
        return beside_curves(self.rows, RANKED_BY)

    @cached_property
    def by_column(self) -> dict[str, Board]:
        """By the name of each frozen planner that planned for models: the same data set with its rows alone."""
        table = self.control
        planned = {name: rows_of_column(table, name) for name in table.columns} if table is not None else {}
        return {
            name: replace(self, rows=tuple(rows), control=None, agreement=())
            for name, rows in planned.items()
            if any(row.kind == "measured" for row in rows)
        }

    @property
    def by_headline(self) -> Board | None:
        """That of the headline's column; None where no model has any."""
        return self.by_column.get(HEADLINE.name)

    def reference(self, name: str) -> Mapping[str, Value]:
        """The figures of a reference, by its name in reports; none where it was not scored."""
        words = REFERENCE_WORDS.get(name, name)
        return next((row.figures for row in self.rows if row.kind == "reference" and row.name == words), {})

    @property
    def entries(self) -> list[Entry]:
        """All entries behind it."""
        return [entry for row in self.rows for entry in row.entries] + (self.control.entries if self.control else [])


def make_boards(entries: Iterable[Entry]) -> list[Board]:
    """Make the boards of some entries.

    Published rows stand on each board of their environment whose actions are one agent's discrete ones, as the papers'.
    """
    groups: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    published: dict[str, list[Entry]] = defaultdict(list)
    for entry in sorted(entries, key=lambda one: one.slug):  # whichever comes first, the same rows
        if entry.is_measured:
            groups[_board_key(entry)].append(entry)
        else:
            published[entry.environment].append(entry)
    control = {
        key: column_table([entry for entry in own if entry.column is not None], REFERENCE_WORDS)
        for key, own in groups.items()
    }
    tables = [table for table in control.values() if table is not None]
    boards = [_board(own, published.get(key[0], []), control[key], tables) for key, own in groups.items()]
    lonely = set(published) - {key[0] for key in groups}
    boards += [Board(environment=name, rows=_sorted(map(_published_row, published[name]))) for name in lonely]
    return sorted(
        boards,
        key=lambda board: (board.environment, -board.version, board.protocol, board.dataset, board.fingerprint),
    )


def _board_key(entry: Entry) -> tuple[str, ...]:
    settings, dataset = entry.content["settings"], entry.content["dataset"]
    of = entry.environment, str(entry.version), dataset["name"], dataset["fingerprint"]
    return *of, str(settings["split"]), str(settings["protocol"])


def _board(
    every: Sequence[Entry], published: Sequence[Entry], control: ColumnTable | None, tables: Sequence[ColumnTable]
) -> Board:
    """The board of some entries.

    Args:
        every: Its entries.
        published: Those of its environment.
        control: The table of those whose control a column planned.
        tables: Such tables of all boards.
    """
    environment, _, dataset, fingerprint, split, protocol = _board_key(every[0])
    entries = [entry for entry in every if entry.column is None]
    planner, usual = _planner_of(entries), _usual_settings(entries)
    groups: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    seen: dict[tuple[str, ...], int] = defaultdict(int)
    for entry in entries:
        key = _row_key(entry)
        one = (*key, str(entry.content["seed"]))
        groups[*key, str(seen[one])].append(entry)  # somebody else's run of the same name and seed is no further seed
        seen[one] += 1
    measured = _told_apart([_measured_row(own, planner, usual) for own in groups.values()])
    comparable = published if entries and entries[0].actions == "discrete" else ()
    rows = [*_ranked(measured), *map(_published_row, comparable), *_reference_rows(entries, planner, usual)]
    counts = [figure["n"] for entry in entries if (figure := entry.figures.get(RANKED_BY)) and figure["n"]]
    return Board(
        environment=environment,
        version=every[0].version,
        dataset=dataset,
        fingerprint=fingerprint,
        recording=next((shlex.join(words) for entry in every if (words := entry.record_words())), ""),
        split=split,
        protocol=protocol,
        triplets=int(max(counts)) if counts else None,
        rows=_sorted(rows),
        control=control,
        agreement=agreements(measured, tables),
    )


def _planner_of(entries: Iterable[Entry]) -> Planner | None:
    """The planner whose control a board compares, of those that its entries have; None without control."""
    planners = Counter(entry.planner for entry in entries if entry.planner is not None)
    present = [one for one in planners if one.version == CONTROL_VERSION] or [*planners]
    return max(sorted(present, key=str), key=planners.__getitem__, default=None)


def _usual_settings(entries: Iterable[Entry]) -> dict[str, str]:
    """Of each figure the settings that most entries measured it with, where other settings than a board's decide it."""
    found: dict[str, Counter[str]] = defaultdict(Counter)
    for entry in entries:
        for figure in entry.figures:
            found[figure][entry.decisive(figure)] += 1
    return {figure: max(sorted(counts), key=counts.__getitem__) for figure, counts in found.items()}


def _row_key(entry: Entry) -> tuple[str, ...]:
    return *training_of(entry), str(entry.content["settings"]["precision"])


def _measured_row(entries: Sequence[Entry], planner: Planner | None, usual: Mapping[str, str]) -> Row:
    first = entries[0]
    mine = planner if any(entry.planner == planner for entry in entries) else _planner_of(entries)
    arch, own, precision = first.content["arch"], first.trained_on, first.content["settings"]["precision"]
    unsound = any(CONTRACT in entry.content["remarks"] for entry in entries)
    return Row(
        kind="measured",
        name=first.model,
        model=first.model,
        variant=", ".join(
            [f"{arch} architecture"] * (arch != "compact")
            + [first.label_use] * bool(first.label_use)
            + [f"trained on {own}"] * (own is not None)
            + [f"predicted in {precision}"] * (precision != "float32")
            + ["breaks the contract"] * unsound
        ),
        elsewhere=own is not None,
        labels=first.labels,
        label_count=first.label_count,
        entries=tuple(sorted(entries, key=lambda entry: (entry.content["seed"], entry.slug))),
        figures=values_of(
            [_compared(entry.figures, entry, mine, usual) for entry in entries],
            [_compared(entry.by_episode, entry, mine, usual) for entry in entries],
        ),
        planner=mine,
        planned_otherwise=mine not in (planner, None),
        unsound=unsound,
    )


def _compared(
    figures: Mapping[str, _T], entry: Entry, planner: Planner | None, usual: Mapping[str, str]
) -> dict[str, _T]:
    """The figures of an entry, without those of another planner, and those measured with unusual settings."""
    return {
        name: figure
        for name, figure in figures.items()
        if (entry.planner == planner or not name.startswith(CONTROLLED))
        and usual.get(name, "") in ("", entry.decisive(name))
    }


def _told_apart(rows: list[Row]) -> list[Row]:
    """Give rows what is unusual about them, and those of the same model, architecture and budget different names.

    Both are taken from their runs' names.
    """
    alone = [_beyond(row, unusual_settings) for row in rows]
    apart = _where_alike(rows, alone, [_beyond(row, _settings_or_name) for row in rows])
    apart = _where_alike(apart, apart, [_beyond(row, settings_of) for row in rows])
    return _where_alike(apart, apart, [_by_weights(row) for row in apart])


def _settings_or_name(entry: Entry) -> str:
    """What is unusual about a run, or its name where that does not say."""
    unusual = unusual_settings(entry)
    return settings_of(entry) if unusual is None else unusual


def _where_alike(of: list[Row], rows: list[Row], instead: list[Row]) -> list[Row]:
    """``rows``, and the others in the place of those whose row of ``of`` shares its model, variant and budget."""
    names = [(row.model, row.variant, row.labels) for row in of]
    counts = Counter(names)
    return [other if counts[name] > 1 else row for row, other, name in zip(rows, instead, names, strict=True)]


def _by_weights(row: Row) -> Row:
    """The row with the beginning of its weights' hash as its variant."""
    return _beyond(row, lambda entry: f"weights {entry.content['weights'][:8]}")


def _beyond(row: Row, told: Callable[[Entry], str | None]) -> Row:
    """The row with something more in its variant."""
    return replace(row, variant=", ".join(part for part in (row.variant, told(row.entries[0])) if part))


def _published_row(entry: Entry) -> Row:
    return Row(
        kind="published",
        name=entry.model,
        model=entry.model,
        labels=entry.labels,
        label_count=entry.label_count,
        entries=(entry,),
        figures=values_of([entry.figures]),
    )


def _reference_rows(entries: Sequence[Entry], planner: Planner | None, usual: Mapping[str, str]) -> list[Row]:
    """The rows of the references; entries of the same board and planner have the same figures for them.

    Of them the oracle alone plans; where nothing is known of it with the board's planner, another's is marked.
    """
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    own_first = sorted(entries, key=lambda entry: entry.planner != planner)
    oracle = next((entry.planner for entry in own_first if _planned(entry.content["reference"].get(ORACLE))), planner)
    for entry in own_first:
        for name, figures in entry.content["reference"].items():
            if name == "paper":
                continue
            mine = oracle if name == ORACLE else entry.planner
            for figure, value in _compared(figures, entry, mine, usual).items():
                found[name].setdefault(figure, value)
    return [
        Row(
            kind="reference",
            name=REFERENCE_WORDS.get(name, name),
            figures=values_of([figures]),
            planner=oracle if name == ORACLE else None,
            planned_otherwise=name == ORACLE and oracle != planner,
        )
        for name, figures in found.items()
        if figures
    ]


def _planned(figures: Mapping[str, Any] | None) -> bool:
    """Whether some figures are of control."""
    return any(name.startswith(CONTROLLED) for name in figures or ())


def _ranked(rows: list[Row]) -> list[Row]:
    """The measured rows, each with its paired difference from the best, and whether it leads in control."""
    names = _all_figures(row for row in rows if not row.planned_otherwise)
    if steps := control_steps(names):
        rows = _leading(rows, f"control_distance[{steps[-1]}]")
    ranked = [row for row in rows if RANKED_BY in row.figures and not row.unsound]
    if not ranked:
        return rows
    best = min(ranked, key=lambda row: row.figures[RANKED_BY].mean)
    return [
        replace(row, is_best=True) if row is best else replace(row, behind=_difference(row, best, RANKED_BY))
        for row in rows
    ]


def _all_figures(rows: Iterable[Row]) -> set[str]:
    return {name for row in rows for name in row.figures}


def _leading(rows: list[Row], figure: str) -> list[Row]:
    """The rows, with a mark on those that have the lowest value of a figure or are tied with it."""
    able = [row for row in rows if figure in row.figures and not row.planned_otherwise and not row.unsound]
    best = min(able, key=lambda row: row.figures[figure].mean, default=None)
    if best is None:
        return rows
    marked = []
    for row in rows:
        apart = None if row is best or row.unsound else _difference(row, best, figure)
        leads = row is best or (apart is not None and apart.low is not None and apart.low <= 0 <= (apart.high or 0))
        marked.append(replace(row, leads=row.leads | {figure}) if leads else row)
    return marked


def _difference(row: Row, best: Row, figure: str) -> Estimate | None:
    """The paired difference of a row from the best; None if their control figures are of different planners."""
    controlled = figure.startswith(CONTROLLED)
    if figure not in row.figures or (controlled and row.planner != best.planner):
        return None
    sums = [
        [
            entry.by_episode[figure]
            for entry in one.entries
            if figure in entry.by_episode and (not controlled or entry.planner == one.planner)
        ]
        for one in (row, best)
    ]
    if any(len(own) != one.figures[figure].seeds for own, one in zip(sums, (row, best), strict=True)):
        return None
    return difference_by_episode(*sums)


def _sorted(rows: Iterable[Row]) -> tuple[Row, ...]:
    def key(row: Row) -> tuple[float, str]:
        value = row.figures.get(RANKED_BY) or row.figures.get(TRUE_MOTION.figure)
        return (float("inf") if value is None else value.mean, row.name)

    return tuple(sorted(rows, key=key))
