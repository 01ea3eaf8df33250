"""The charts of a board: error against labels, error over the rollout, control over time."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from dmotion_bench.planning.columns import HEADLINE
from leaderboard.board import OTHER_PLANNER, REFERENCE_WORDS, Board
from leaderboard.board_tables import tuned_words
from leaderboard.chart import COLORS, MARKERS, Axis, Guide, Point, Series, Style, key, line_chart
from leaderboard.columns import POSITION_CHARGED, POSITION_FOUND, UNWANTED, count, number
from leaderboard.efficiency import SHOT, WITHIN, common_budgets, learned, lines_of, needed_of_rows, of_budgets
from leaderboard.markup import Markup, element, joined
from leaderboard.row import Row

Styles = Mapping[tuple[str, str], Style]
"""By model and variant."""
OWN: Final = 2
"""So many of the first models have a colour that no other model has."""
COPYING: Final = REFERENCE_WORDS["copy_last"]
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
    """A board and, where it has control by the headline's frozen planner, the rows of that as another."""
    return [board] if board.by_headline is None else [board, board.by_headline]


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
    if any(_dash(row) == "dashed" for one in _sides(board) for row in one.rows_beside_curves):
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
        _labels(board, styles, "mse", "MSE", where),
        _labels(board, styles, "position_error_paper", f"{POSITION_CHARGED.lower()} [px]", where),
        _relative(board, styles, "mse", where),
        _against_copying(board, styles, "mse", where),
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
        _control(board.by_headline, styles, f"Control by the frozen planner {HEADLINE.title}: {where}"),
    ]
    return element("div", *drawn, class_="charts") if any(drawn) else None


def _labels(board: Board, styles: Styles, figure: str, words: str, where: str) -> Markup | None:
    """The label-efficiency curve: a line for each model, over its budgets."""
    groups: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in board.rows:
        if row.kind != "reference" and row.label_count and figure in row.figures:
            groups[row.kind, row.model, row.variant].append(row)
    series = [
        Series(
            name=f"{rows[0].title}: " + ", ".join(f"{row.labels} {number(row.figures[figure].mean)}" for row in rows),
            points=[
                replace(_point(float(row.label_count or 0), row, figure), ringed=SHOT in row.labels) for row in rows
            ],
            style=styles[rows[0].model, rows[0].variant],
            dash="dotted" if rows[0].kind == "published" else "dashed" if rows[0].elsewhere else "solid",
            hollow=rows[0].kind == "published",
        )
        for own in groups.values()
        for rows in lines_of(own)
    ]
    if not series:
        return None
    title = f"Label efficiency, {words.partition(',')[0].partition(' [')[0]}: {where}"
    chart = line_chart(
        title,
        _label_axis(series),
        Axis(label=words, log=True),
        series,
        _guides(board, figure),
    )
    rows = sorted((row for own in groups.values() for row in own), key=lambda row: (row.label_count or 0, row.title))
    numbers = _numbers(
        ("model", "labels", words),
        [
            (row.title, f"{row.labels} ({count(row.label_count or 0)})", number(row.figures[figure].mean))
            for row in rows
        ],
    )
    return _figure(chart, title, numbers)


def _relative(board: Board, styles: Styles, figure: str, where: str) -> Markup | None:
    """Label curves as multiples of each model's own error with all labels, and the labels that each needs.

    Without models that make no error with all labels, of which there are no multiples.
    """
    every = _same_trainings(board, figure)
    curves = {name: rows for name, rows in every.items() if rows[-1].figures[figure].mean > 0}
    if not curves:
        return None
    copied = board.reference("copy_last").get(figure)
    title = f"Worth of labels: {where}"
    series = [_divided(rows, figure, styles[name], rows[-1].figures[figure].mean) for name, rows in curves.items()]
    budgets = common_budgets(board.label_curves.values())
    needed = {
        name: needed_of_rows(rows, figure, budgets)
        for name, rows in board.label_curves.items()
        if learned(rows, figure, None if copied is None else copied.mean)
    }
    guides = [Guide("with all labels", 1.0), Guide(f"{WITHIN:.0%} above", 1 + WITHIN)]
    chart = line_chart(title, _label_axis(series), Axis(label="MSE / own with all labels", log=True), series, guides)
    numbers = _numbers(
        ("model", f"labels to within {WITHIN:.0%} of its own with all, and the 95% interval where it reaches further"),
        [
            (rows[-1].title, "" if name not in needed else found.words if (found := needed[name]) else "not comparable")
            for name, rows in curves.items()
        ],
    )
    return _figure(chart, title, numbers)


def _against_copying(board: Board, styles: Styles, figure: str, where: str) -> Markup | None:
    """Label curves as shares of the error of copying the last frame; None where nothing ever moves."""
    curves = _same_trainings(board, figure)
    copied = board.reference("copy_last").get(figure)
    if not curves or copied is None or copied.mean <= 0:
        return None
    title = f"Label efficiency against copying: {where}"
    series = [_divided(rows, figure, styles[name], copied.mean) for name, rows in curves.items()]
    chart = line_chart(
        title, _label_axis(series), Axis(label="MSE / copying's", log=True), series, [Guide(COPYING, 1.0)]
    )
    numbers = _numbers(
        ("model", "labels", "MSE / copying's"),
        [
            (row.title, f"{row.labels} ({count(row.label_count or 0)})", number(row.figures[figure].mean / copied.mean))
            for rows in curves.values()
            for row in rows
        ],
    )
    return _figure(chart, title, numbers)


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
            points=[_point(bad, row, action)],
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
    numbers = _numbers(
        ("model", "labels", "read of the action", "most read of the rest [R²]", "which is"),
        [(row.title, row.labels, number(good), number(bad), what) for row, good, what, bad in read],
    )
    return _figure(line_chart(title, x, y, series, guides), title, numbers, note="Best is at the top left.")


def _most_unwanted(row: Row) -> tuple[str, float] | None:
    """What a latent action should not hold and a probe reads best of it, and how well."""
    found = {
        words: row.figures[name].mean
        for factor, words in UNWANTED.items()
        if (name := f"probe_mlp[{factor}]") in row.figures
    }
    return max(found.items(), key=lambda one: one[1]) if found else None


def _divided(rows: Sequence[Row], figure: str, style: Style, by: float) -> Series:
    values = [row.figures[figure].mean / by for row in rows]
    return Series(
        name=f"{rows[0].title}: " + ", ".join(f"{row.labels} {number(y)}" for row, y in zip(rows, values, strict=True)),
        points=[
            Point(x=float(row.label_count or 0), y=y, ringed=SHOT in row.labels)
            for row, y in zip(rows, values, strict=True)
        ],
        style=style,
    )


def _label_axis(series: Sequence[Series]) -> Axis:
    """The axis of the numbers of labels; those that most series have are labelled first."""
    having = Counter(labels for one in series for labels in {point.x for point in one.points})
    counts = sorted(having, key=lambda labels: (-having[labels], labels))
    return Axis(label="action labels used", log=True, ticks=counts)


def _same_trainings(board: Board, figure: str) -> dict[tuple[str, str], list[Row]]:
    """The board's label curves, each of the trainings that have all its budgets, as far as there are some."""
    return {
        name: of_budgets(rows, figure, [row.label_count or 0 for row in rows])
        for name, rows in board.label_curves.items()
    }


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
    numbers = _numbers(
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
    return _figure(chart, title, numbers, note=f"Dotted: {told}." if still else "")


def _control(board: Board | None, styles: Styles, title: str) -> Markup | None:
    """The distance that is left over the steps of control."""
    if board is None:
        return None
    words = "distance to the goal / at the start"
    return _ahead(board, styles, "control_distance", words, "control step", title, every=10)


def _figure(chart: Markup, title: str, numbers: Markup, note: str = "") -> Markup:
    kind = title.partition(":")[0]
    return element(
        "figure",
        element("figcaption", element("b", kind), f" {note}" if note else None),
        chart,
        element("details", element("summary", "The numbers"), numbers),
    )


def _numbers(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    head = element("tr", *(element("th", heading, scope="col") for heading in headings))
    body = [
        element("tr", element("th", first, scope="row"), *(element("td", text) for text in rest))
        for first, *rest in rows
    ]
    table = element("table", element("thead", head), element("tbody", joined(body)))
    return element("div", table, class_="scroll", tabindex=0, role="region", aria_label="Numbers of the chart")


def _point(x: float, row: Row, figure: str) -> Point:
    value = row.figures[figure]
    return Point(x=x, y=value.mean, low=value.low, high=value.high)


def _steps(row: Row, base: str) -> list[Point]:
    places = [(int(found[2]), name) for name in row.figures if (found := _AHEAD.fullmatch(name)) and found[1] == base]
    start = [Point(x=0.0, y=1.0)] if base == "control_distance" and places and min(places)[0] > 0 else []
    return start + [_point(float(step), row, name) for step, name in sorted(places)]


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


def _guides(board: Board, figure: str) -> list[Guide]:
    return [
        Guide(row.name, row.figures[figure].mean)
        for row in board.rows
        if row.kind == "reference" and figure in row.figures
    ]


def _dash(row: Row) -> str:
    if row.kind == "published":
        return "dotted"
    return "solid" if row.labels in ("one-shot", "100%") and not row.elsewhere else "dashed"
