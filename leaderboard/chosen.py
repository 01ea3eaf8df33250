"""The few rows that a front page shows, chosen by a TOML file and filled from the entries.

::

    [[row]]
    name = "control"                   # how a sentence of the page refers to it
    title = "control tasks"            # what is measured, in words that follow a number
    model_title = "DMotion"            # the model, in words
    board = "robot_push-small"         # the data set's name; with "@" and a fingerprint's beginning where two share it
    model = "dmotion"                  # registry name
    variant = "warp true"              # as on the board; left out if it has none
    labels = "one-shot"                # label budget
    figure = "control_distance[100]"
    baseline = "idle"                  # a reference of the board; left out for figures that none of them has
    column = "generic"                 # of control by a frozen planner; left out for all other figures
    in_table = true                    # false for figures that only sentences of the page name

Boards of another version of scoring or control, and of the paper's split, are not looked at.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import UsageError
from leaderboard.board import AGENT_MOVES, REFERENCE_WORDS, Board
from leaderboard.board_tables import budget, labels, trainings, tuned
from leaderboard.column_table import rows_of_column
from leaderboard.markdown import plain, table
from leaderboard.markdown_numbers import between, figure, mean
from leaderboard.row import Row
from leaderboard.value import Value

TUNED_MARK: Final = "†"
TUNED_NOTE: Final = f"{TUNED_MARK} The planner was tuned on the tasks of this row."


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A row as the file asks for it; the module says what each field means."""

    name: str
    title: str
    model_title: str
    board: str
    model: str
    labels: str
    figure: str
    baseline: str = ""
    variant: str = ""
    column: str = ""
    in_table: bool = True


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """A row that was found.

    Attributes:
        choice: What was asked for.
        board, row: Where it stands.
        value, baseline: Its figure, and the same of the baseline, if it asks for one.
        agent_alone: The same of the reference that moves only the agent, where the board has it.
        paper: What was published of the same model and budget, if anything was.
    """

    choice: Choice
    board: Board
    row: Row
    value: Value
    baseline: Value | None
    agent_alone: Value | None
    paper: Value | None

    @property
    def tuned(self) -> bool:
        """Whether the planner was tuned on tasks of the figure, or this is unknown."""
        return tuned(self.board, self.row, self.choice.figure) not in ("", "no")

    def numbers(self) -> dict[str, str]:
        """The numbers of the row that sentences can use, by the word after the full stop in ``NAME.word``."""
        return {
            "": mean(self.value),
            "interval": "" if self.value.interval is None else between(*self.value.interval),
            "labels": labels(self.row),
            "trainings": f"{self.value.seeds}",
            "samples": f"{self.value.samples or 0:,}",
            "baseline": mean(self.baseline),
            "paper": mean(self.paper),
        }


def read_choices(path: Path) -> list[Choice]:
    """The rows that a file asks for.

    Raises:
        UsageError: It cannot be read, or a row has other fields.
    """
    try:
        rows = tomllib.loads(path.read_text())["row"]
        return [_choice(row) for row in rows]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{str(path)!r} names no rows to show: {error}. It holds [[row]] tables with the fields "
            f"{', '.join(field.name for field in fields(Choice))}."
        ) from None


def _choice(row: Mapping[str, Any]) -> Choice:
    shown = row.get("in_table", True)
    if not isinstance(shown, bool):
        raise TypeError("in_table is true or false")
    words = {name: str(value) for name, value in row.items() if name != "in_table"}
    return Choice(**words, in_table=shown)


def find_rows(choices: Sequence[Choice], boards: Sequence[Board]) -> list[Chosen]:
    """The rows on the boards.

    Raises:
        UsageError: One is not there; says what is.
    """
    return [_found(choice, boards) for choice in choices]


def _found(choice: Choice, boards: Sequence[Board]) -> Chosen:
    name, _, fingerprint = choice.board.partition("@")
    compared = [one for one in boards if one.dataset and one.protocol != "paper" and not one.made_by]
    near = {f"{one.dataset}@{one.fingerprint[:8]}": one for one in compared}
    matching = [one for one in near.values() if one.dataset == name and one.fingerprint.startswith(fingerprint)]
    board = _only(choice, "board", choice.board, matching, list(near))
    of_column = [] if board.control is None else rows_of_column(board.control, choice.column)
    rows = of_column if choice.column else board.rows
    able = {_key(row): row for row in rows if row.kind == "measured" and choice.figure in row.figures}
    wanted = (choice.model, choice.variant, choice.labels)
    row = _only(choice, "row", wanted, [row for key, row in able.items() if key == wanted], list(able))
    words = REFERENCE_WORDS.get(choice.baseline, choice.baseline)
    references = {one.name: one for one in rows if one.kind == "reference" and choice.figure in one.figures}
    baseline = (
        _only(choice, "baseline", words, [one for one in [references.get(words)] if one], list(references))
        if choice.baseline
        else None
    )
    agent_alone = references.get(REFERENCE_WORDS[AGENT_MOVES])
    paper = [
        one for one in board.rows if one.kind == "published" and (one.model, one.labels) == (row.model, row.labels)
    ]
    return Chosen(
        choice=choice,
        board=board,
        row=row,
        value=row.figures[choice.figure],
        baseline=baseline.figures[choice.figure] if baseline else None,
        agent_alone=agent_alone.figures[choice.figure] if agent_alone else None,
        paper=paper[0].figures.get(choice.figure) if paper else None,
    )


def _key(row: Row) -> tuple[str, str, str]:
    return row.model, row.variant, row.labels


def _only(choice: Choice, kind: str, wanted: object, found: Sequence[Any], known: Sequence[object]) -> Any:
    if len(found) != 1:
        how = "several are" if found else "none is"
        raise UsageError(
            f"the row {choice.name!r} asks for the {kind} {wanted!r}, and {how} there with {choice.figure!r}; "
            f"there are: {', '.join(map(str, known)) or 'none'}."
        )
    return found[0]


def chosen_table(rows: Sequence[Chosen]) -> list[str]:
    """The lines of the table of the chosen rows, with a note where a planner was tuned on their tasks."""
    measured = ["World", "Measured on", "Model", "Labels", "Trainings", "Error (95% interval)"]
    head = [*measured, "Reference", "Agent alone", "Paper"]
    shown = [row for row in rows if row.choice.in_table]
    lines = table(head, [_cells(row) for row in shown], words=3)
    return [*lines, "", TUNED_NOTE] if any(row.tuned for row in shown) else lines


def _cells(one: Chosen) -> list[str]:
    return [
        plain(one.board.title),
        f"{one.value.samples or 0:,} {one.choice.title}",
        one.choice.model_title,
        budget(one.row),
        trainings(one.row, one.choice.figure).partition(":")[0],
        figure(one.value) + (f"\u00a0{TUNED_MARK}" if one.tuned else ""),
        mean(one.baseline),
        mean(one.agent_alone),
        mean(one.paper),
    ]


def numbers(rows: Sequence[Chosen]) -> Mapping[str, str]:
    """Every number that a sentence may ask for: ``NAME`` or ``NAME.interval``, ``NAME.paper`` ..."""
    return {
        f"{row.choice.name}.{part}".rstrip("."): plain(text)
        for row in rows
        for part, text in row.numbers().items()
        if text
    }
