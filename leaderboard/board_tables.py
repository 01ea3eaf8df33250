"""A board as Markdown: a table of predictions and one of control, with the paper's figures beside ours."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from functools import partial

from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.registry import environment_title
from dmotion_bench.scoring.statistics import Estimate
from dmotion_bench.wording import rounded
from leaderboard.agreement import JOINED
from leaderboard.board import OTHER_PLANNER, Board
from leaderboard.column_table import SOLVED_AT, ColumnRow, ColumnTable, Outcome, detectable_words
from leaderboard.columns import POSITION_CHARGED, POSITION_FOUND, control_columns, named
from leaderboard.comparison import GAIN_CAPTURED
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.label_table import label_lines
from leaderboard.markdown import WIDTH, code, paragraph, plain, table
from leaderboard.markdown_numbers import TO, between, figure, mean, of_some
from leaderboard.planners import tuned_share
from leaderboard.row import Row, each
from leaderboard.usual import RANKED_BY
from leaderboard.value import Value

Cell = Callable[[Row], str]


def board_section(board: Board) -> list[str]:
    """The lines of a board: its heading, what it was measured on, and its tables."""
    made_by = f", {plain(board.made_by)}" if board.made_by else ""
    lines = [f"### {world(board)}: {plain(board.dataset)} ({board.fingerprint[:8]}){made_by}", ""]
    protocols = sorted({str(entry.content["protocol"]) for entry in board.entries if entry.is_measured})
    told = [named("Protocol", list(map(plain, protocols))), f"split by {plain(board.protocol)}"]
    lines.append(", ".join([*told, *([f"{board.triplets:,} predicted frames"] if board.triplets else [])]) + ".")
    if board.recording:
        words = f"Its data set is recorded by {code(board.recording)}."
        lines += ["", *textwrap.wrap(words, WIDTH, break_long_words=False, break_on_hyphens=False)]
    if board.measured:
        lines += ["", *_predictions(board)]
    if curves := label_lines(board):
        lines += ["", *curves]
    if board.agreement:
        lines += ["", *agreement_lines(board)]
    if board.control is not None:
        lines += ["", *column_lines(board.control)]
    control = _control(board)
    if control and board.control is not None:
        lines += ["", "Control of protocol dmbench-1, by planners that were tuned on some of its tasks:"]
    return [*lines, "", *control] if control else lines


def column_lines(control: ColumnTable) -> list[str]:
    """The table of control by columns, and what it cannot show."""
    columns: dict[str, Callable[[ColumnRow], str]] = {
        "Model": lambda row: plain(row.title),
        "Labels": lambda row: budget_words(row.label_count, row.labels) if row.entries else "",
        "Trainings": lambda row: each_trainings(row, control.columns),
        "Tasks": lambda row: " / ".join(sorted({str(cell.tasks) for cell in row.cells.values()}, key=int)),
    }
    for name in control.columns:
        columns[f"{COLUMNS[name].title}: left"] = partial(_of_column, name, left)
        columns[f"{COLUMNS[name].title}: solved"] = partial(_of_column, name, solved)
    lines = table(list(columns), [[cell(row) for cell in columns.values()] for row in control.rows])
    words = [f"Distance left after {control.steps} steps, with the 95% interval over tasks and trainings."]
    words += [f"Solved: {SOLVED_AT:g} of the distance or less, with Wilson's interval."]
    words += [detectable_words(control, rounded)]
    return [*lines, "", *textwrap.wrap(" ".join(words).rstrip(), WIDTH)]


def _of_column(name: str, words: Callable[[Outcome | None], str], row: ColumnRow) -> str:
    return words(row.cells.get(name))


def each_trainings(row: ColumnRow, columns: Sequence[str]) -> str:
    """How many trainings a row is of: once if it is the same in all columns, else of each column that it has."""
    counts = [str(cell.trainings or "") for name in columns if (cell := row.cells.get(name)) is not None]
    return " / ".join(counts if len(set(counts)) > 1 else counts[:1])


def left(cell: Outcome | None) -> str:
    """The distance left, with its interval."""
    if cell is None:
        return ""
    one = cell.left
    return rounded(one.mean) + ("" if one.low is None else f" ({between(one.low, one.high)})")


def solved(cell: Outcome | None) -> str:
    """The share of solved tasks, with its interval."""
    if cell is None:
        return ""
    share, low, high = cell.solved
    return f"{share:.0%} ({low:.0%}{TO}{high:.0%})"


def agreement_lines(board: Board) -> list[str]:
    """With what the gain captured agrees, over the board's rows."""
    head = ["Gain captured with", "Rows", "Spearman's correlation"]
    rows = [
        [plain(one.figure), str(one.correlation.n), f"{one.correlation.mean:.2f}{_signed(one.correlation)}"]
        for one in board.agreement
    ]
    lines = table(head, rows, words=1)
    return [*lines, "", *textwrap.wrap(JOINED, WIDTH)] if any(one.joined for one in board.agreement) else lines


def _signed(one: Estimate) -> str:
    return "" if one.low is None else f" ({one.low:.2f}{TO}{one.high:.2f})"


def world(board: Board) -> str:
    """The environment in words, with its version, as Markdown."""
    return f"{plain(environment_title(board.environment))} v{board.version}"


def published_section(board: Board) -> list[str]:
    """The lines of the figures that were published of an environment."""
    rows = [row for row in board.rows if row.kind == "published"]
    sources = sorted({str(entry.content["source"]) for row in rows for entry in row.entries})
    notes = sorted({str(entry.content["note"]) for row in rows for entry in row.entries})
    last = _last_distance(rows)
    columns: dict[str, Cell] = {
        "Model": lambda row: plain(row.name),
        "Labels": budget,
        "MSE": lambda row: figure(row.figures.get("mse")),
        f"{POSITION_CHARGED} [px]": lambda row: figure(row.figures.get("position_error_paper")),
    }
    if last is not None:
        columns["Distance left"] = lambda row: figure(row.figures.get(last))
    said = paragraph(" ".join([f"{', '.join(sources)}.", *notes]))
    return [f"### {plain(environment_title(board.environment))}: as published", "", *said, "", *_lines(columns, rows)]


def _predictions(board: Board) -> list[str]:
    rows = [row for row in board.rows_beside_curves if row.kind != "published" and RANKED_BY in row.figures]
    paper = {(row.model, row.labels): row for row in board.rows if row.kind == "published"}

    columns: dict[str, Cell] = {
        "Model": lambda row: plain(row.title),
        "Labels": budget,
        "Trainings": lambda row: trainings(row, RANKED_BY),
        "MSE": lambda row: known(row, RANKED_BY, partial(figure, strong=row.ties)),
        "paper": lambda row: mean(_published(paper, row).get(RANKED_BY)),
        "pushes": lambda row: known(row, "mse_push", mean),
        "15 ahead": lambda row: known(row, "rollout_mse[15]", mean),
        f"{POSITION_CHARGED} [px]": lambda row: known(row, "position_error_paper", figure),
        f"{POSITION_FOUND} [px]": lambda row: known(row, "position_error", mean),
        "Gain captured": _gain,
    }
    return _lines(columns, rows)


def known(row: Row, name: str, words: Callable[[Value | None], str]) -> str:
    """A figure of a row in words and, where some of its trainings lack it, how many have it."""
    value = row.figures.get(name)
    return words(value) + of_some(value, row.seeds)


def _gain(row: Row) -> str:
    """The gain captured, with its interval if it is of all trainings of the row and their entries tell it."""
    value = row.figures.get(GAIN_CAPTURED)
    text = _formatted(value, ".2f") + of_some(value, row.seeds)
    if value is None or value.interval is None or value.seeds < row.seeds:
        return text
    low, high = value.interval
    return f"{text} ({low:.2f}{TO}{high:.2f})"


def _control(board: Board) -> list[str]:
    last = _last_distance([row for row in board.rows if row.kind != "published"])
    if last is None:
        return []
    rows = [row for row in board.rows if row.kind != "published" and last in row.figures]
    paper = {(row.model, row.labels): row for row in board.rows if row.kind == "published"}
    steps = last.partition("[")[2].rstrip("]")

    def beside(row: Row, name: str, words: Callable[[Value | None], str]) -> str:
        value = row.figures.get(name)
        return words(value) + of_some(value, row.figures[last].seeds)

    columns: dict[str, Cell] = {
        "Model": lambda row: plain(row.title) + (f", {OTHER_PLANNER}" if row.planned_otherwise else ""),
        "Labels": budget,
        "Trainings": lambda row: trainings(row, last),
        "Tasks": lambda row: f"{row.figures[last].samples or ''}",
        f"Left after {steps} steps": lambda row: figure(row.figures[last], strong=last in row.leads),
        "paper": lambda row: mean(_published(paper, row).get(last)),
        "after 40": lambda row: beside(row, "control_distance[40]", mean),
        "Solved": lambda row: beside(row, "control_success", partial(_formatted, form=".0%")),
        "Lost": lambda row: beside(row, "control_lost", partial(_formatted, form=".3g")),
        "Tuned here": lambda row: tuned(board, row, last),
    }
    return _lines(columns, sorted(rows, key=lambda row: row.figures[last].mean))


def _last_distance(rows: Sequence[Row]) -> str | None:
    """The distance at the end of control, by its fixed name; None where there is none."""
    compared = [row for row in rows if not row.planned_otherwise] or rows
    names = {name for row in compared for name in row.figures if name.startswith(CONTROLLED)}
    return next((one.figure for one in control_columns(names) if "distance" in one.figure), None)


def _published(paper: dict[tuple[str, str], Row], row: Row) -> dict[str, Value]:
    """What was published of a row's model with its budget."""
    found = paper.get((row.model, row.labels))
    return {} if found is None or not row.model else dict(found.figures)


def _lines(columns: dict[str, Cell], rows: Sequence[Row]) -> list[str]:
    """A table of the columns that say something of at least one row."""
    cells = {head: [cell(row) for row in rows] for head, cell in columns.items()}
    heads = [head for head, column in cells.items() if any(column)]
    return table(heads, [[cells[head][place] for head in heads] for place in range(len(rows))])


def _formatted(value: Value | None, form: str) -> str:
    return "" if value is None else format(value.mean, form)


def labels(row: Row) -> str:
    """How many labels a row's model was given."""
    if row.kind == "reference":
        return ""
    return "?" if row.label_count is None else f"{row.label_count:,}"


def budget(row: Row) -> str:
    """The same, and of demonstrations how many of each action: as many labels of any actions are another budget."""
    return "" if row.kind == "reference" else budget_words(row.label_count, row.labels)


def budget_words(count: int | None, asked: str) -> str:
    """A number of labels as a cell of a table, with what the budget gives of each action, such as ``4 (1 each)``."""
    known = "?" if count is None else f"{count:,}"
    return f"{known} ({each(asked)})" if each(asked) else known


def trainings(row: Row, name: str) -> str:
    """How many trainings a figure is the mean of and, of several, the lowest and the highest."""
    value = row.figures[name]
    if row.kind != "measured":
        return ""
    return f"{value.seeds}" if value.seeds == 1 else f"{value.seeds}: {rounded(value.low)} to {rounded(value.high)}"


def tuned(board: Board, row: Row, name: str) -> str:
    """Whether a row's planner was tuned on the tasks that a figure is about; empty if the row has no planner."""
    tasks = row.figures[name].samples
    if row.planner is None or not tasks or not name.startswith(CONTROLLED):
        return ""
    share = tuned_share(row.planner.version, board.fingerprint, tasks)
    if share is None:
        return "not known"
    return "no" if not share else "yes" if share == 1 else f"{share:.0%}"


def tuned_words(board: Board, row: Row, name: str) -> str:
    """The same behind a row's name in a legend: empty where the planner was not tuned on these tasks."""
    said = tuned(board, row, name)
    return "" if said in ("", "no") else ", tuned here" if said == "yes" else f", tuned here: {said}"
