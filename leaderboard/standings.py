"""The tables of a board for predictions and control: one row per model, sortable by every column (``page.js``)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.scoring.differences import standing
from leaderboard.agreement import JOINED
from leaderboard.board import OTHER_PLANNER, Board
from leaderboard.board_tables import tuned
from leaderboard.column_table import SOLVED_AT, ColumnRow, ColumnTable, detectable_words
from leaderboard.columns import Column, columns_for, control_columns, count, interval, named, number, signed
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.markup import Markup, element, joined
from leaderboard.row import EACH_MEANING, Row, each
from leaderboard.usual import RANKED_BY
from leaderboard.value import Value

SHOWN_SEPARATELY = "as published"
PUBLISHED = "published"
"""Behind a board's anchor: where its published rows were printed."""
BEHIND = "MSE above the best"
DEVICES = {"cuda": "GPU", "cpu": "CPU"}
OTHER_PLANNER_NOTE = (
    f" Where it says '{OTHER_PLANNER}', the actions are those of other settings or another version: what they "
    "led to holds, but it is not compared with the others."
)


def standings(board: Board, anchor: str) -> Markup:
    """The tables of predictions: of the rows, and, folded away, of the points of label curves.

    The references of control stand in that of control.
    """
    beside = board.rows_beside_curves
    rows = [row for row in beside if not row.figures or not set(row.figures) <= _of_control(row.figures)]
    table = _predictions(board, rows, anchor, "caption")
    points = [row for row in board.rows if row not in beside]
    if not points:
        return table
    words = f"The label curves' points: {len(points)} more rows, each a model with a number of labels"
    folded = element("details", element("summary", words), _predictions(board, points, anchor, "points-caption"))
    return joined([table, folded])


def _predictions(board: Board, rows: Sequence[Row], anchor: str, caption: str) -> Markup:
    columns = columns_for({name for row in rows for name in row.figures}, board.sequences)
    return _table(board, rows, columns, anchor, caption, ranks=RANKED_BY)


def control_standings(board: Board, anchor: str) -> Markup | None:
    """The table of control; None where it has not been scored."""
    columns = control_columns({name for row in board.rows for name in row.figures})
    rows = [row for row in board.rows if any(column.figure in row.figures for column in columns)]
    distances = [column.figure for column in columns if column.figure.startswith("control_distance")]
    if not rows or not distances:
        return None
    last = distances[0]
    tasks = sorted({int(entry.figures[last]["n"] or 0) for entry in board.measured if last in entry.figures})
    rows.sort(key=lambda row: row.figures[last].mean if last in row.figures else float("inf"))
    return element(
        "section",
        element("h3", "Control" if board.control is None else "Control, protocol dmbench-1"),
        element(
            "p",
            f"{' or '.join(map(count, tasks)) + ' tasks' if tasks else 'Tasks'}: "
            "bring the objects to where the goal's image has them. "
            "A distance is the simulator's, divided by that at the start; doing nothing leaves 1."
            + (OTHER_PLANNER_NOTE if any(row.planned_otherwise for row in rows) else ""),
            class_="note",
        ),
        _table(board, rows, columns, anchor, "control-caption", ranks=last, words=", control"),
    )


def column_standings(control: ColumnTable, anchor: str) -> Markup:
    """The table of control by columns: what each frozen planner leaves with each model."""
    heads = [("Model", ""), ("Labels", f"Action labels that the model was given. {EACH_MEANING}")]
    each_column = [
        ("solved", f"Share of the tasks that end with {SOLVED_AT:g} of the distance or less, with Wilson's interval."),
        ("lost", "Objects that fall off the table, per task."),
    ]
    head = [_heading(*one) for one in heads]
    for place, name in enumerate(control.columns):
        heads.append((f"{COLUMNS[name].title}: left", COLUMNS[name].meaning))
        head.append(_heading(*heads[-1], sorted_up=not place))
        head += [_heading(*one) for one in each_column]
    body = [_column_row(row, control.columns) for row in control.rows]
    caption = f"{anchor}-columns-caption"
    table = element(
        "table",
        element("caption", "Control by frozen planners", id=caption),
        element("thead", element("tr", *head)),
        element("tbody", joined(body)),
        class_="standings",
    )
    protocols = sorted({COLUMNS[name].protocol for name in control.columns})
    return element(
        "section",
        element("h3", f"Control, {named('protocol', protocols)}"),
        element(
            "p",
            f"The distance left after {control.steps} steps, on tasks that nothing was tuned on. Small print: the 95% "
            f"interval over tasks and trainings; of shares, Wilson's interval. {detectable_words(control, number)}",
            class_="note",
        ),
        element("div", table, class_="scroll", tabindex=0, role="region", aria_labelledby=caption),
        _meanings([*heads, *each_column]),
    )


def _column_row(row: ColumnRow, columns: Sequence[str]) -> Markup:
    name = element("a", row.name, href=f"#{row.entries[0].slug}") if row.entries else element("span", row.name)
    small = element("small", row.small or ("" if row.entries else "reference"))
    labels = "" if row.label_count is None else count(row.label_count)
    cells = [
        element("th", name, small, scope="row", data_value=row.title),
        element("td", labels, element("small", _budget(row.labels)), data_value=row.label_count),
    ]
    for column in columns:
        cell = row.cells.get(column)
        if cell is None:
            cells += [element("td", "")] * 3
            continue
        share, low, high = cell.solved
        trained = {0: "", 1: ", one training"}.get(cell.trainings, f", {cell.trainings} trainings")
        between = "" if cell.left.low is None else f"95%: {interval(cell.left.low, cell.left.high)}, "
        said = f"{between}{cell.tasks} tasks{trained}"
        cells += [
            element("td", number(cell.left.mean), element("small", said), data_value=repr(cell.left.mean)),
            element("td", f"{share:.0%}", element("small", f"95%: {low:.0%} to {high:.0%}"), data_value=repr(share)),
            element("td", number(cell.lost), data_value=repr(cell.lost)),
        ]
    return element("tr", *cells, class_="measured" if row.entries else "reference")


def agreement_note(board: Board) -> Markup | None:
    """With what the gain captured agrees, over the board's rows; None where there are too few."""
    if not board.agreement:
        return None
    said = "; ".join(
        f"{one.figure} {one.correlation.mean:.2f} ("
        + ("" if one.correlation.low is None else f"{one.correlation.low:.2f} to {one.correlation.high:.2f}, ")
        + f"{one.correlation.n} rows)"
        for one in board.agreement
    )
    joined = f" {JOINED}" if any(one.joined for one in board.agreement) else ""
    words = f"Rank correlation of the gain captured with other figures, over rows: {said}.{joined}"
    return element("p", words, class_="note")


def _of_control(figures: Iterable[str]) -> set[str]:
    return {name for name in figures if name.startswith(CONTROLLED)}


def _table(
    board: Board,
    rows: Sequence[Row],
    columns: Sequence[Column],
    anchor: str,
    caption_id: str,
    *,
    ranks: str,
    words: str = "",
) -> Markup:
    """One table, sorted by the column that ranks, and what its columns mean."""
    caption_id = f"{anchor}-{caption_id}"
    extra = _extra_columns(board, rows, ranks)
    heads = [("Model", ""), ("Labels", f"Action labels that the model was given, and the budget. {EACH_MEANING}")]
    head = [_heading(*one) for one in heads]
    for column in columns:
        heads.append((column.heading, column.meaning))
        head.append(_heading(column.heading, column.meaning, unit=column.unit, sorted_up=column.figure == ranks))
        if column.figure == RANKED_BY and BEHIND in extra:
            heads.append((BEHIND, extra[BEHIND][0]))
            head.append(_heading(*heads[-1]))
    for name, (meaning, _) in extra.items():
        if name != BEHIND:
            heads.append((name, meaning))
            head.append(_heading(name, meaning))
    body = [_row(row, columns, extra, anchor, controlled=ranks != RANKED_BY) for row in rows]
    caption = f"{board.title}{f', {board.dataset}' if board.dataset else ''}{words}"
    table = element(
        "table",
        element("caption", caption, id=caption_id),
        element("thead", element("tr", *head)),
        element("tbody", joined(body)),
        class_="standings",
    )
    return joined(
        [
            element("div", table, class_="scroll", tabindex=0, role="region", aria_labelledby=caption_id),
            _meanings(heads),
        ]
    )


def _meanings(heads: Sequence[tuple[str, str]]) -> Markup:
    """What the columns of a table mean, folded below it."""
    told = (joined([element("dt", name), element("dd", meaning)]) for name, meaning in heads if meaning)
    return element("details", element("summary", "What the columns mean"), element("dl", joined(told)))


def _extra_columns(board: Board, rows: Sequence[Row], ranks: str) -> dict[str, tuple[str, Callable[[Row], Markup]]]:
    """The columns that are no figures: what each means, and its cell of a row; those that say something."""
    found: dict[str, tuple[str, Callable[[Row], Markup]]] = {}
    if ranks != RANKED_BY:
        if any(row.figures.get(ranks) and tuned(board, row, ranks) for row in rows):
            meaning = "Whether the planner was tuned on the very tasks of the row; its figures are then too good."
            found["Tuned here"] = meaning, partial(_tuned, board, ranks)
        return found
    if any(row.behind is not None for row in rows):
        meaning = (
            "Paired over the test episodes, with the 95% interval of the difference, which is over several trainings, "
            "too; tied where the interval reaches zero."
        )
        found[BEHIND] = meaning, _behind
    if any(_compute(row) for row in rows):
        meaning = "Time of the training, of all seeds together, and on what. A GPU does more in the same time."
        found["Compute"] = meaning, _computed
    return found


def _tuned(board: Board, ranks: str, row: Row) -> Markup:
    said = tuned(board, row, ranks) if ranks in row.figures else ""
    return element("td", said, data_value=said or None)


def _computed(row: Row) -> Markup:
    seconds = _compute(row)
    told = ", ".join(f"{_duration(own)} {device}" for device, own in seconds.items())
    return element("td", told, data_value=sum(seconds.values()) or None)


def _heading(text: str, meaning: str = "", *, unit: str = "", sorted_up: bool = False) -> Markup:
    return element(
        "th",
        text,
        element("small", f" [{unit}]") if unit else None,
        scope="col",
        title=meaning or None,
        aria_sort="ascending" if sorted_up else None,
    )


def _row(
    row: Row,
    columns: Sequence[Column],
    extra: Mapping[str, tuple[str, Callable[[Row], Markup]]],
    anchor: str,
    *,
    controlled: bool,
) -> Markup:
    cells = [_name(row, OTHER_PLANNER if controlled and row.planned_otherwise else "", anchor), _labels(row)]
    for column in columns:
        cells.append(_value(row, row.figures.get(column.figure), strong=_is_strong(row, column.figure)))
        if column.figure == RANKED_BY and BEHIND in extra:
            cells.append(_behind(row))
    cells += [cell(row) for name, (_, cell) in extra.items() if name != BEHIND]
    return element("tr", *cells, class_=row.kind)


def _name(row: Row, remark: str, anchor: str) -> Markup:
    if row.kind == "measured":
        name: Markup = element("a", row.name, href=f"#{row.entries[0].slug}")
        seeds = f"{row.seeds} seeds" if row.seeds > 1 else f"seed {row.entries[0].content['seed']}"
        small = ", ".join(part for part in (row.variant, seeds, remark) if part)
    elif row.kind == "published":
        name = element("a", row.name, href=f"#{anchor}-{PUBLISHED}")
        small = SHOWN_SEPARATELY
    else:
        name, small = element("span", row.name), f"reference, {remark}" if remark else "reference"
    return element("th", name, element("small", small), scope="row", data_value=row.title)


def _labels(row: Row) -> Markup:
    if row.kind == "reference":
        return element("td", "")
    known = "?" if row.label_count is None else count(row.label_count)
    return element("td", known, element("small", _budget(row.labels)), data_value=row.label_count)


def _budget(labels: str) -> str:
    """A budget as small print: demonstrations of each action are another budget than a number of labels."""
    return f"{labels}: {each(labels)}" if each(labels) else "any actions" if labels.isdecimal() else labels


def _is_strong(row: Row, figure: str) -> bool:
    """Whether no row is significantly better."""
    return row.ties if figure == RANKED_BY else figure in row.leads


def _value(row: Row, value: Value | None, *, strong: bool) -> Markup:
    if value is None:
        return element("td", "")
    small = []
    if row.kind == "published":
        small += [f"\u00b1 {number(value.std)}"] * (value.std is not None)
    elif value.interval is not None:
        small.append(f"95%: {interval(*value.interval)}")
    if value.seeds > 1:
        small.append(f"seeds: {interval(value.low, value.high)}")
    if row.kind == "measured" and value.seeds < row.seeds:
        small.append(f"{value.seeds} of {row.seeds} seeds")
    mean = element("b", number(value.mean)) if strong else number(value.mean)
    return element("td", mean, *(element("small", one) for one in small), data_value=repr(value.mean))


def _behind(row: Row) -> Markup:
    if row.is_best:
        return element("td", "best", data_value="0")
    if row.behind is None:
        return element("td", "")
    difference = row.behind
    between = interval(difference.low, difference.high, sign=True)
    words = {"tie": "tie", "unknown": f"unknown, {difference.episodes} episodes"}
    said = "" if row.unsound else words.get(standing(difference), "")
    text = f"{said} ({signed(difference.mean)})" if said else signed(difference.mean)
    return element("td", text, element("small", between) if between else None, data_value=repr(difference.mean))


def _compute(row: Row) -> dict[str, float]:
    """Seconds of training of all seeds together, by the kind of device; none if unknown."""
    found: dict[str, float] = {}
    for entry in row.entries:
        training = entry.content["training"] if entry.is_measured else {}
        seconds, device = training.get("seconds"), str(training.get("device", "")).partition(":")[0]
        if isinstance(seconds, int | float) and seconds:
            name = DEVICES.get(device, device)
            found[name] = found.get(name, 0.0) + float(seconds)
    return found


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
