"""Boards from entries: one board per data set, one row per model, architecture and label budget.

Runs that differ in nothing but their seed are one row. Its value is the mean over these trainings; beside it stand
their range and the 95% interval over test episodes and trainings. Who is better is not read from these: each row is
compared with the best by the paired difference (``comparison.py``), whose interval is over both, too.

Control is as good as the planner, so only what one planner did in the same tasks is averaged and compared: of those of
this dmbench's version, or, where nothing of it is there, of all, the one that planned most. Rows that have none of it
keep another's, marked. Rollouts and the gain captured that were measured with other settings than most are left out.
What another version of scoring made stands on a board of its own.
"""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

from dmotion_bench.planning.columns import HEADLINE
from dmotion_bench.registry import environment_title, environment_versions
from dmotion_bench.scoring.report import CONTRACT
from dmotion_bench.specs import DatasetRecipe
from leaderboard.agreement import Agreement, agreements
from leaderboard.column_table import ORACLE, ColumnTable, column_table, rows_of_column
from leaderboard.columns import TRUE_MOTION
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.control import PUBLISHED
from leaderboard.efficiency import beside_curves, label_curves
from leaderboard.entry import USUAL_PRECISION, Entry
from leaderboard.ranking import ranked
from leaderboard.row import Row
from leaderboard.run_names import settings_of, training_of, unusual_settings
from leaderboard.usual import OTHER_FRAMES, RANKED_BY, Usual, most_common, planner_of, shared_figures, to_tell_apart
from leaderboard.value import Value, values_of

OTHER_PLANNER: Final = "another planner"
"""Marks a row of control that is not compared."""
AGENT_MOVES: Final = "agent_moves"

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
        made_by: Which other version of scoring, or of the control by columns, made its figures, in words; empty of this
            dmbench's. What two versions made stands on two boards.
        dataset, fingerprint: Of the data set; empty where only published results are known.
        recipe: Of the data set; None where it is not known.
        recording: The command that records the data set; empty where it is not known, or was no recording.
        split, protocol: Which episodes, and how triplets were split.
        triplets: Single steps that were scored; None where nothing was.
        sequences: Action sequences that the gain captured compares; None where that is not known.
        rows: The best first, then the published rows and the references where their error puts them.
        control: The table of control by columns; None where nothing was scored for it.
        agreement: How well the gain captured agrees with other figures.
    """

    environment: str
    version: int = 1
    dataset: str = ""
    fingerprint: str = ""
    recipe: DatasetRecipe | None = None
    recording: str = ""
    split: str = ""
    protocol: str = ""
    made_by: str = ""
    triplets: int | None = None
    sequences: int | None = None
    rows: tuple[Row, ...]
    control: ColumnTable | None = None
    agreement: tuple[Agreement, ...] = ()

    @property
    def title(self) -> str:
        """The environment in words, with the version of the data where the environment has several."""
        name = environment_title(self.environment)
        several = self.version > 1 or (self.fingerprint and environment_versions(self.environment))
        named = f"{name}, version {self.version}" if several else name
        return f"{named}, {self.made_by}" if self.made_by else named

    @property
    def key(self) -> tuple[str, ...]:
        """What its figures have in common: of two boards of one page different."""
        of = self.environment, str(self.version), self.protocol, self.dataset, self.fingerprint
        return *of, self.split, self.made_by

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
        key: column_table([entry for entry in own if entry.column is not None], REFERENCE_WORDS, made_by=key[-1])
        for key, own in groups.items()
    }
    tables = [table for table in control.values() if table is not None]
    boards = [_board(own, published.get(key[0], []), control[key], tables) for key, own in groups.items()]
    lonely = set(published) - {key[0] for key in groups}
    boards += [Board(environment=name, rows=_sorted(map(_published_row, published[name]))) for name in lonely]
    return sorted(
        boards,
        key=lambda board: (board.environment, -board.version, *board.key[2:]),
    )


def _board_key(entry: Entry) -> tuple[str, ...]:
    settings, dataset = entry.content["settings"], entry.content["dataset"]
    of = entry.environment, str(entry.version), str(settings["protocol"]), dataset["name"], dataset["fingerprint"]
    return *of, str(settings["split"]), entry.made_by


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
    environment, _, protocol, dataset, fingerprint, split, made_by = _board_key(every[0])
    entries = [entry for entry in every if entry.column is None]
    usual = Usual.of(entries)
    measured = _told_apart([_measured_row(*row, usual) for row in _rows_of(entries, usual)])
    comparable = published if entries and entries[0].actions == "discrete" else ()
    rows = [*ranked(measured), *map(_published_row, comparable), *_reference_rows(entries, usual)]
    counts = [figure["n"] for entry in entries if (figure := entry.figures.get(RANKED_BY)) and figure["n"]]
    triplets = max(counts, default=None) if usual.frames is None else sum(usual.frames.counts)
    return Board(
        environment=environment,
        version=every[0].version,
        dataset=dataset,
        fingerprint=fingerprint,
        recipe=next((recipe for entry in every if (recipe := entry.recipe) is not None), None),
        recording=next((shlex.join(words) for entry in every if (words := entry.record_words())), ""),
        split=split,
        protocol=protocol,
        made_by=made_by,
        triplets=None if triplets is None else int(triplets),
        sequences=usual.sequences,
        rows=_sorted(rows),
        control=control,
        agreement=agreements(measured, tables),
    )


def _rows_of(entries: Iterable[Entry], usual: Usual) -> list[tuple[list[Entry], str]]:
    """The entries of each row, and what is odd about them in words.

    A row has a training once: somebody else's run of the same name and seed is no further seed, and weights that are
    there under another seed are no further training.
    """
    rows: dict[tuple[str, ...], list[tuple[list[Entry], str]]] = defaultdict(list)
    for entry in entries:
        odd = OTHER_FRAMES if usual.leaves_out(entry) else ""
        own = rows[*training_of(entry), entry.precision, odd]
        seed, weights = (entry.content[name] for name in ("seed", "weights"))
        known = [other.content["seed"] for row, _ in own for other in row if other.content["weights"] == weights]
        if known and seed not in known:
            own.append(([entry], f"the weights of seed {known[0]} as seed {seed}"))
            continue
        places = (row for row, _ in own if all(seed != other.content["seed"] for other in row))
        if (row := next(places, None)) is None:
            own.append(([entry], odd))
        else:
            row.append(entry)
    return [row for own in rows.values() for row in own]


def _measured_row(entries: Sequence[Entry], odd: str, usual: Usual) -> Row:
    first, planner = entries[0], usual.planner
    mine = planner if any(entry.planner == planner for entry in entries) else planner_of(entries)
    arch, own, precision = first.content["arch"], first.trained_on, first.precision
    unsound = any(CONTRACT in entry.content["remarks"] for entry in entries)
    return Row(
        kind="measured",
        name=first.model,
        model=first.model,
        variant=", ".join(
            [f"{arch} architecture"] * (arch != "compact")
            + [first.label_use] * bool(first.label_use)
            + [f"trained on {own}"] * (own is not None)
            + [f"predicted in {precision}"] * (precision != USUAL_PRECISION)
            + [odd] * bool(odd)
            + ["breaks the contract"] * unsound
        ),
        elsewhere=own is not None,
        labels=first.labels,
        label_count=most_common((entry, entry.label_count) for entry in entries),
        entries=tuple(sorted(entries, key=lambda entry: (entry.content["seed"], entry.slug))),
        figures=values_of(
            [usual.compared(entry.figures, entry, mine) for entry in entries],
            [usual.compared(entry.by_episode, entry, mine) for entry in entries],
        ),
        planner=mine,
        planned_otherwise=mine not in (planner, None),
        unsound=unsound,
        apart=bool(odd) or precision != usual.precision,
    )


def _told_apart(rows: list[Row]) -> list[Row]:
    """Give rows what is unusual about them, and those of the same model, architecture and budget different names.

    Both are taken from their runs' names. Where these do not tell rows apart, the one with most trainings keeps its
    name.
    """
    counts = Counter(map(_called, rows))
    told = [_beyond(row, _settings_or_name if counts[_called(row)] > 1 else unusual_settings) for row in rows]
    told = _where_alike(told, [_beyond(row, settings_of) for row in rows])
    return _where_alike(told, [_by_weights(row) for row in told])


def _settings_or_name(entry: Entry) -> str:
    """What is unusual about a run, or its name where that does not say."""
    unusual = unusual_settings(entry)
    return settings_of(entry) if unusual is None else unusual


def _called(row: Row) -> tuple[str, str, str]:
    return row.model, row.variant, row.labels


def _where_alike(rows: list[Row], instead: list[Row]) -> list[Row]:
    """The rows, and the others in the place of those that have to be told from a row of the same name."""
    apart = to_tell_apart([*map(_called, rows)], [row.seeds for row in rows])
    return [other if told else row for row, other, told in zip(rows, instead, apart, strict=True)]


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


def _reference_rows(entries: Sequence[Entry], usual: Usual) -> list[Row]:
    """The rows of the references; entries of the same board and planner have the same figures for them.

    Of them the oracle alone plans; where nothing is known of it with the board's planner, another's is marked.
    """
    planner = usual.planner
    own_first = sorted(entries, key=lambda entry: entry.planner != planner)
    oracle = next((entry.planner for entry in own_first if _planned(entry.content["reference"].get(ORACLE))), planner)
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    for is_own in (False, True):
        said = [
            (entry, name, usual.compared(figures, entry, oracle if name == ORACLE else entry.planner))
            for entry in entries
            for name, figures in entry.content["reference"].items()
            if name != PUBLISHED and (entry.planner == planner) is is_own
        ]
        for name, figures in shared_figures(said).items():
            found[name] |= figures
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


def _sorted(rows: Iterable[Row]) -> tuple[Row, ...]:
    def key(row: Row) -> tuple[float, str]:
        value = row.figures.get(RANKED_BY) or row.figures.get(TRUE_MOTION.figure)
        return (float("inf") if value is None else value.mean, row.name)

    return tuple(sorted(rows, key=key))
