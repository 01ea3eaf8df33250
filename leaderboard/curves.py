"""The charts of a board: error against labels, error over the rollout, control over time."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from dmotion_bench.planning.columns import COLUMNS
from leaderboard.board import OTHER_PLANNER, Board
from leaderboard.board_tables import tuned_words
from leaderboard.chart import COLORS, MARKERS, Axis, Guide, Point, Series, Style, key, line_chart
from leaderboard.chart_figure import Styles, chart_figure, chart_numbers, point_of
from leaderboard.columns import DISTANCE_LEFT, POSITION_FOUND, UNWANTED, number
from leaderboard.efficiency import SHOT
from leaderboard.label_charts import label_charts
from leaderboard.markup import Markup, element
from leaderboard.row import Row

OWN: Final = 2
"""So many of the first models have a colour that no other model has."""
_AHEAD: Final = re.compile(r"(\w+)\[(\d+)\]")


def assign_styles(boards: Iterable[Board]) -> dict[tuple[str, str], Style]:
    """The colour of each model and the marker of each variant of it, the same on every board of a page.

    The models that were measured on most boards come first. As long as there are colours each has its own; the others
    share those that are not of the first models. On a board no two lines have the same colour and marker, as far as
    there are markers.
    """
    boards = list(boards)
    drawn = {one for board in boards for one in _drawn(board)}
    ranked = sorted({model for model, _ in drawn}, key=lambda model: (-_measured_on(model, boards), model))
    places = dict(zip(ranked, range(len(ranked)), strict=True))
    hues = {one: at if at < COLORS else OWN + (at - COLORS) % (COLORS - OWN) for one, at in places.items()}
    styles: dict[tuple[str, str], Style] = {}
    for index, one in enumerate(sorted(drawn, key=lambda one: (places[one[0]], one[1]))):
        beside = {other for board in boards if one in (own := _drawn(board)) for other in own}
        taken = {style.shape for other, style in styles.items() if other in beside and style.hue == hues[one[0]]}
        free = next((shape for shape in range(MARKERS) if shape not in taken), index)
        styles[one] = Style(index, hue=hues[one[0]], shape=free)
    return styles


def _measured_on(model: str, boards: Iterable[Board]) -> int:
    """On how many boards a model was measured."""
    return sum(any(row.kind == "measured" and row.model == model for row in board.rows) for board in boards)


def _drawn(board: Board) -> list[tuple[str, str]]:
    """The models and variants that a board has lines of."""
    return sorted({(row.model, row.variant) for one in _sides(board) for row in one.rows if row.model})


def _sides(board: Board) -> list[Board]:
    """A board and, of each frozen planner that planned there, the rows of that as another."""
    return [board, *board.by_column.values()]


def legend(board: Board, styles: Styles) -> Markup:
    """The legend of the charts; each model is a button that highlights its lines (``page.js``)."""
    items = []
    for model, variant in _drawn(board):
        style, name = styles[model, variant], f"{model} ({variant})" if variant else model
        button = element("button", key(style), name, type="button", aria_pressed="false", data_model=style.index)
        items.append(element("li", button))
    if any(SHOT in row.labels and row.label_count for row in board.rows):
        ring = element("span", key(Style(-1), ringed=True), "ringed: demonstrations of each action", class_="kind")
        items.append(element("li", ring))
    kinds = []
    if any(_dash(row) == "dashed" for one in _sides(board) for row in one.rows_beside_curves if row.model):
        elsewhere = ", or trained on another data set" if any(row.elsewhere for row in board.rows) else ""
        kinds.append(f"dashed: a share of the labels, or more demonstrations than one{elsewhere}")
    if any(row.kind == "published" for row in board.rows):
        kinds.append("hollow and dotted: as published")
    return element(
        "div",
        element("ul", *items, class_="legend", aria_label="Models in the charts"),
        element("p", "; ".join(kinds).capitalize() + ".", class_="note") if kinds else None,
    )


def charts(board: Board, styles: Styles) -> Markup | None:
    """All charts that the board's figures allow, each with its numbers as a table; None where there is none."""
    where = f"{board.title}{f' ({board.dataset})' if board.dataset else ''}"
    drawn = [
        *label_charts(board, styles, where),
        _probes(board, styles, where),
        _ahead(board, styles, "rollout_mse", "MSE", "steps ahead", f"Error over the rollout: {where}", log=True),
        _ahead(
            board,
            styles,
            "rollout_position_error",
            f"{POSITION_FOUND.lower()} [px]",
            "steps ahead",
            f"Position error over the rollout: {where}",
            log=True,
        ),
        _control(board, styles, f"Control: {where}"),
        *(
            _control(planned, styles, f"Control by the frozen planner {COLUMNS[name].title}: {where}")
            for name, planned in board.by_column.items()
        ),
    ]
    return element("div", *drawn, class_="charts") if any(drawn) else None


def _probes(board: Board, styles: Styles, where: str) -> Markup | None:
    """What probes read of the action against the most that they read of anything else: one point a row."""
    action, chance = "probe_mlp[action]", "probe_mlp_shuffled[action]"
    read = [
        (row, row.figures[action].mean, *most)
        for row in board.rows_beside_curves
        if row.model and action in row.figures and not _is_covered(row, board) and (most := _most_unwanted(row))
    ]
    if not read:
        return None
    title = f"What the latent action holds: {where}"
    series = [
        Series(
            name=f"{row.title}, labels {row.labels}: action {number(good)}, {what} {number(bad)}",
            points=[point_of(bad, row, action)],
            style=styles[row.model, row.variant],
        )
        for row, good, what, bad in read
    ]
    chances = [row.figures[chance].mean for row, *_ in read if chance in row.figures]
    guides = [Guide("chance", sum(chances) / len(chances))] if chances else []
    whole = (0, 0.25, 0.5, 0.75, 1)
    x, y = (
        Axis(label="read of what it should not hold [R²]", ticks=whole),
        Axis(label="read of the action", ticks=whole),
    )
    numbers = chart_numbers(
        ("model", "labels", "read of the action", "most read of the rest [R²]", "which is"),
        [(row.title, row.labels, number(good), number(bad), what) for row, good, what, bad in read],
    )
    return chart_figure(line_chart(title, x, y, series, guides), title, numbers, note="Best is at the top left.")


def _most_unwanted(row: Row) -> tuple[str, float] | None:
    """What a latent action should not hold and a probe reads best of it, and how well."""
    found = {
        words: row.figures[name].mean
        for factor, words in UNWANTED.items()
        if (name := f"probe_mlp[{factor}]") in row.figures
    }
    return max(found.items(), key=lambda one: one[1]) if found else None


def _ahead(
    board: Board, styles: Styles, base: str, words: str, along: str, title: str, *, log: bool = False, every: int = 5
) -> Markup | None:
    """A figure over the steps of a rollout or of a control task, one line a row.

    Not a line for several demonstrations of each action where there is one for one: it would cover it. The numbers
    have both.
    """
    curves = {row.title + row.labels: (row, _steps(row, base)) for row in board.rows_beside_curves if row.model}
    curves = {name: (row, points) for name, (row, points) in curves.items() if len(points) > 1}
    if not curves:
        return None
    lengths = {point.x for _, points in curves.values() for point in points}
    every = every if max(lengths) >= 2 * every else 1
    marked = frozenset(step for step in lengths if step % every == 0 or step == min(lengths))
    series = [
        Series(
            name=f"{_title(board, row, base)}, labels {row.labels}",
            points=points,
            style=styles[row.model, row.variant],
            dash=_dash(row),
            hollow=row.kind == "published",
            marked=marked,
        )
        for row, points in curves.values()
        if not _is_covered(row, board)
    ]
    still = [
        Series(
            name=row.title,
            points=points,
            style=Style(-1),
            dash="dotted",
            hollow=True,
            marked=frozenset(),
            labelled=base == "control_distance",
        )
        for row in board.rows
        if row.kind == "reference" and len(points := _steps(row, base)) > 1
    ]
    ticks = sorted(step for step in marked) if len(marked) < 12 else ()
    chart = line_chart(title, Axis(label=along, ticks=ticks), Axis(label=words, log=log, zero=True), [*still, *series])
    shown = sorted(marked)
    told = ", ".join(one.name for one in still)
    numbers = chart_numbers(
        ("model", "labels", *(f"{step:g}" for step in shown)),
        [
            (name, labels, *(number(values.get(step)) for step in shown))
            for name, labels, points in (
                *((_title(board, row, base), row.labels, points) for row, points in curves.values()),
                *((one.name, "", one.points) for one in still),
            )
            if (values := {point.x: point.y for point in points})
        ],
    )
    return chart_figure(chart, title, numbers, note=f"Dotted: {told}." if still else "")


def _steps(row: Row, base: str) -> list[Point]:
    places = [(int(found[2]), name) for name in row.figures if (found := _AHEAD.fullmatch(name)) and found[1] == base]
    start = [Point(x=0.0, y=1.0)] if base == "control_distance" and places and min(places)[0] > 0 else []
    return start + [point_of(float(step), row, name) for step, name in sorted(places)]


def _control(board: Board, styles: Styles, title: str) -> Markup | None:
    """The distance that is left over the steps of control."""
    return _ahead(board, styles, "control_distance", DISTANCE_LEFT, "control step", title, every=10)


def _title(board: Board, row: Row, base: str) -> str:
    """A row's name; in charts of control with a remark if another planner, or one that was tuned here, planned it."""
    if base != "control_distance":
        return row.title
    last = max((name for name in row.figures if name.startswith(base)), key=lambda name: int(name[len(base) + 1 : -1]))
    other = f", {OTHER_PLANNER}" if row.planned_otherwise else ""
    return f"{row.title}{other}{tuned_words(board, row, last)}"


def _is_covered(row: Row, board: Board) -> bool:
    """Whether a row differs from another only by having more than one demonstration of each action."""
    if row.labels == "one-shot" or not row.labels.endswith("-shot"):
        return False
    same = (row.kind, row.model, row.variant, "one-shot")
    return any((one.kind, one.model, one.variant, one.labels) == same for one in board.rows)


def _dash(row: Row) -> str:
    if row.kind == "published":
        return "dotted"
    return "solid" if row.labels in ("one-shot", "100%") and not row.elsewhere else "dashed"
