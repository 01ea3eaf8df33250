"""The charts of a board over the number of labels, and in words what they do not show.

``DRAWN`` lists the figures. Each has a chart of its values. An error is also drawn as multiples of the model's own with
all labels, and of copying's. The gain captured is not: it is a share already, and a multiple of a number that may be
zero or negative means nothing. Control is drawn of the headline's frozen planner, whose rows are on a board of their
own: the data set of the tasks is not that of the training.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from dmotion_bench.planning.columns import HEADLINE
from leaderboard.board import REFERENCE_WORDS, Board
from leaderboard.chart import Axis, Guide, Point, Series, Style, line_chart
from leaderboard.chart_figure import Styles, chart_figure, chart_numbers, point_of, reference_guides
from leaderboard.columns import DISTANCE_LEFT, POSITION_CHARGED, ROLLOUT_STEPS, control_steps, count, number
from leaderboard.comparison import GAIN_CAPTURED
from leaderboard.efficiency import (
    FEWEST_BUDGETS,
    SHOT,
    WITHIN,
    common_budgets,
    label_curves,
    learned,
    lines_of,
    needed_of_rows,
    of_budgets,
)
from leaderboard.markup import Markup
from leaderboard.row import Row
from leaderboard.run_names import training_data_of
from leaderboard.usual import RANKED_BY

COPYING: Final = REFERENCE_WORDS["copy_last"]
_AHEAD: Final = ROLLOUT_STEPS[-1]


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A figure that is drawn over the number of labels.

    Attributes:
        figure: Its fixed name.
        name: What the charts call it.
        axis: What its axis says, the name by default.
        fewest: A model with fewer budgets has no line.
        divided: Whether it is drawn as multiples, too; only of an error, which is never negative.
        higher: Whether more is better.
        log: Whether the axis is logarithmic.
    """

    figure: str
    name: str
    axis: str = ""
    fewest: int = FEWEST_BUDGETS
    divided: bool = False
    higher: bool = False
    log: bool = True


DRAWN: Final = (
    Drawn(figure=RANKED_BY, name="MSE", fewest=1, divided=True),
    Drawn(figure="position_error_paper", name="position error", axis=f"{POSITION_CHARGED.lower()} [px]", fewest=1),
    Drawn(figure=f"rollout_mse[{_AHEAD}]", name=f"MSE {_AHEAD} ahead", divided=True),
    Drawn(figure=GAIN_CAPTURED, name="gain captured", higher=True, log=False),
)
"""The figures, in the order of their charts."""


def label_charts(board: Board, styles: Styles, where: str) -> list[Markup]:
    """The charts over the number of labels that the board's figures allow.

    Args:
        board: Whose rows are drawn.
        styles: Of its models.
        where: What the board is called.
    """
    charts = []
    for drawn in DRAWN:
        charts.append(_plain(board, styles, drawn, where))
        if drawn.divided:
            curves = _same_trainings(board, drawn.figure)
            charts += [
                _relative(board, styles, drawn, curves, where),
                _against_copying(board, styles, drawn, curves, where),
            ]
    if (control := _control(board)) is not None:
        planned, drawn = control
        charts.append(_plain(planned, styles, drawn, where))
    return [chart for chart in charts if chart is not None]


def _control(board: Board) -> tuple[Board, Drawn] | None:
    """The rows whose control is drawn, the headline's first, and what is drawn; None without enough budgets."""
    for planned, planner in ((board.by_headline, f" by the frozen planner {HEADLINE.title}"), (board, "")):
        figures = {name for row in planned.rows for name in row.figures} if planned is not None else ()
        if planned is None or not (steps := control_steps(figures)):
            continue
        drawn = Drawn(
            figure=f"control_distance[{steps[-1]}]", name=f"control{planner}", axis=DISTANCE_LEFT, fewest=1, log=False
        )
        if _groups(planned, drawn.figure, FEWEST_BUDGETS):
            return planned, drawn
    return None


def label_notes(board: Board, boards: Sequence[Board] = ()) -> str:
    """Which models of a board have no curve over labels, and which figures none is drawn of; empty without curves.

    Args:
        board: The board.
        boards: Of the page, itself among them, since control is scored on tasks of another data set than that of the
            training; itself alone by default.
    """
    groups = (name for drawn in DRAWN for name in _groups(board, drawn.figure, FEWEST_BUDGETS))
    having = {model for kind, model, _ in groups if kind == "measured"}
    if not having:
        return ""
    without = sorted({row.model for row in board.rows if row.kind == "measured"} - having)
    told = []
    if without:
        told.append(
            f"No curve over labels: {', '.join(without)}. A model that learns from actions is trained anew for each "
            "budget, so each point of its curve costs a training; a model of video is trained once."
        )
    figures = {name for row in board.rows if row.kind == "measured" for name in row.figures}
    if any(name.startswith("probe_") for name in figures):
        told.append(
            "What probes read of a model of video does not depend on its labels, which only name its latent actions."
        )
    scored_on = [one.dataset for one in boards or [board] if _has_control_of(board, one)]
    if not scored_on:
        told.append("Control is not measured over labels, since every budget would cost planning of its own.")
    elif board.dataset not in scored_on:
        told.append(f"Control over labels is drawn on the board of {' and '.join(dict.fromkeys(scored_on))}.")
    return " ".join(told)


def _has_control_of(board: Board, tasks: Board) -> bool:
    """Whether a board draws control over the labels of a model that was trained on another's data set."""
    if (found := _control(tasks)) is None:
        return False
    planned, drawn = found
    groups = _groups(planned, drawn.figure, FEWEST_BUDGETS).values()
    entries = (entry for rows in groups for row in rows for entry in row.entries)
    return any(training_data_of(entry)["fingerprint"] == board.fingerprint for entry in entries)


def _groups(board: Board, figure: str, fewest: int) -> dict[tuple[str, str, str], list[Row]]:
    """The rows with a figure by kind, model and variant, of those that have it under enough budgets."""
    groups: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in board.rows:
        if row.kind != "reference" and row.label_count and figure in row.figures:
            groups[row.kind, row.model, row.variant].append(row)
    return {name: rows for name, rows in groups.items() if len({row.label_count for row in rows}) >= fewest}


def _plain(board: Board, styles: Styles, drawn: Drawn, where: str) -> Markup | None:
    """The label-efficiency curve: a line for each model, over its budgets.

    A value is of all trainings that there are; where that is fewer than under another budget of the line, it says so.
    """
    figure = drawn.figure
    lines = [rows for own in _groups(board, figure, drawn.fewest).values() for rows in lines_of(own)]
    if not lines:
        return None
    series = [
        Series(
            name=f"{rows[0].title}: " + ", ".join(f"{row.labels} {_value(row, rows, figure)}" for row in rows),
            points=[
                replace(point_of(float(row.label_count or 0), row, figure), ringed=SHOT in row.labels) for row in rows
            ],
            style=styles[rows[0].model, rows[0].variant],
            dash="dotted" if rows[0].kind == "published" else "dashed" if rows[0].elsewhere else "solid",
            hollow=rows[0].kind == "published",
        )
        for rows in lines
    ]
    axis = drawn.axis or drawn.name
    title = f"Label efficiency, {drawn.name}: {where}"
    chart = line_chart(
        title, _label_axis(series), Axis(label=axis, log=drawn.log), series, reference_guides(board, figure)
    )
    rows = sorted(
        ((row, _value(row, own, figure)) for own in lines for row in own),
        key=lambda one: (one[0].label_count or 0, one[0].title),
    )
    numbers = chart_numbers(("model", "labels", axis), [(row.title, _budget(row), value) for row, value in rows])
    return chart_figure(chart, title, numbers, note="Higher is better." if drawn.higher else "")


def _value(row: Row, line: Sequence[Row], figure: str) -> str:
    """A row's figure, and of how many trainings it is where another row of its line has more."""
    value, most = row.figures[figure], max(one.figures[figure].seeds for one in line)
    return number(value.mean) if value.seeds == most else f"{number(value.mean)} ({value.seeds} of {most} trainings)"


def _relative(
    board: Board, styles: Styles, drawn: Drawn, curves: Mapping[tuple[str, str], Sequence[Row]], where: str
) -> Markup | None:
    """Label curves as multiples of each model's own error with all labels and, of the MSE, the labels that it needs.

    Without models that make no error with all labels, of which there are no multiples.
    """
    figure = drawn.figure
    own = {name: rows[-1].figures[figure].mean for name, rows in curves.items()}
    curves = {name: rows for name, rows in curves.items() if own[name] > 0}
    guides = [Guide("with all labels", 1.0), Guide(f"{WITHIN:.0%} above", 1 + WITHIN)]
    title, axis = f"Worth of labels, {drawn.name}: {where}", f"{drawn.name} / own with all labels"
    numbers = _needed(board, curves) if figure == RANKED_BY else None
    return _divided(curves, own, styles, figure, title, axis, guides, numbers)


def _against_copying(
    board: Board, styles: Styles, drawn: Drawn, curves: Mapping[tuple[str, str], Sequence[Row]], where: str
) -> Markup | None:
    """Label curves as shares of the error of copying the last frame; None where nothing ever moves."""
    copied = board.reference("copy_last").get(drawn.figure)
    if copied is None or copied.mean <= 0:
        return None
    title, axis = f"Label efficiency against copying, {drawn.name}: {where}", f"{drawn.name} / copying's"
    return _divided(
        curves, dict.fromkeys(curves, copied.mean), styles, drawn.figure, title, axis, [Guide(COPYING, 1.0)]
    )


def _divided(
    curves: Mapping[tuple[str, str], Sequence[Row]],
    by: Mapping[tuple[str, str], float],
    styles: Styles,
    figure: str,
    title: str,
    axis: str,
    guides: Sequence[Guide],
    numbers: Markup | None = None,
) -> Markup | None:
    """A chart of label curves, each divided by a number of its own; its numbers are the quotients by default."""
    if not curves:
        return None
    series = [_quotients(rows, figure, styles[name], by[name]) for name, rows in curves.items()]
    chart = line_chart(title, _label_axis(series), Axis(label=axis, log=True), series, guides)
    quotients = [
        (row.title, _budget(row), number(row.figures[figure].mean / by[name]))
        for name, rows in curves.items()
        for row in rows
    ]
    return chart_figure(chart, title, numbers or chart_numbers(("model", "labels", axis), quotients))


def _quotients(rows: Sequence[Row], figure: str, style: Style, by: float) -> Series:
    values = [row.figures[figure].mean / by for row in rows]
    return Series(
        name=f"{rows[0].title}: " + ", ".join(f"{row.labels} {number(y)}" for row, y in zip(rows, values, strict=True)),
        points=[
            Point(x=float(row.label_count or 0), y=y, ringed=SHOT in row.labels)
            for row, y in zip(rows, values, strict=True)
        ],
        style=style,
    )


def _needed(board: Board, curves: Mapping[tuple[str, str], Sequence[Row]]) -> Markup:
    """The labels that each model needs to come close to its own MSE with all labels."""
    copied = board.reference("copy_last").get(RANKED_BY)
    budgets = common_budgets(board.label_curves.values())
    needed = {
        name: needed_of_rows(rows, RANKED_BY, budgets)
        for name, rows in board.label_curves.items()
        if learned(rows, RANKED_BY, None if copied is None else copied.mean)
    }
    return chart_numbers(
        ("model", f"labels to within {WITHIN:.0%} of its own with all, and the 95% interval where it reaches further"),
        [
            (rows[-1].title, "" if name not in needed else found.words if (found := needed[name]) else "not comparable")
            for name, rows in curves.items()
        ],
    )


def _budget(row: Row) -> str:
    return f"{row.labels} ({count(row.label_count or 0)})"


def _label_axis(series: Sequence[Series]) -> Axis:
    """The axis of the numbers of labels; those that most series have are labelled first."""
    having = Counter(labels for one in series for labels in {point.x for point in one.points})
    counts = sorted(having, key=lambda labels: (-having[labels], labels))
    return Axis(label="action labels used", log=True, ticks=counts)


def _same_trainings(board: Board, figure: str) -> dict[tuple[str, str], list[Row]]:
    """A figure's label curves, each of the trainings that have all its budgets, as far as there are some."""
    return {
        name: of_budgets(rows, figure, [row.label_count or 0 for row in rows])
        for name, rows in label_curves(board.rows, figure).items()
    }
