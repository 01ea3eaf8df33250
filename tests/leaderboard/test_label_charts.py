"""The charts over the number of labels: where each value is drawn, what is divided by what, and what is left out."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from dmotion_bench.planning.columns import HEADLINE
from leaderboard.board import Board, make_boards
from leaderboard.chart_figure import point_of
from leaderboard.curves import assign_styles
from leaderboard.entry import Entry
from leaderboard.label_charts import label_charts, label_notes
from leaderboard.page import make_page
from leaderboard.row import Row
from leaderboard.value import Value

from .conftest import TASK_EPISODES

Budgeted = Callable[..., Entry]
BUDGETS = (("4", 4), ("16", 16), ("100%", 64))
ROLLOUT, GAIN = "rollout_mse[15]", "planning_gain"


def _entries(budgeted: Budgeted, model: str, figure: str, *values: float) -> list[Entry]:
    """A model's entries under the last of the budgets, with a figure's values."""
    budgets = BUDGETS[-len(values) :]
    return [
        budgeted(model, labels, total, 1.0, **{figure: value})
        for (labels, total), value in zip(budgets, values, strict=True)
    ]


def _charts(board: Board) -> dict[str, str]:
    """The charts by what they are called."""
    drawn = label_charts(board, assign_styles([board]), "here")
    return {re.findall(r"<figcaption><b>(.*?)</b>", chart)[0]: str(chart) for chart in drawn}


def _line(chart: str, model: str) -> list[tuple[float, float]]:
    """Where the line of a model is."""
    ((path,),) = (
        re.findall(rf"<title>{re.escape(model)}:[^<]*</title>(?:<path[^>]*bar[^>]*>)*<path d=\"(.*?)\"", chart),
    )
    return [(float(x), float(y)) for x, y in re.findall(r"[ML](\S+?) ([^\sL]+)", path)]


def _numbers(chart: str) -> list[tuple[str, ...]]:
    """The lines of the table below a chart."""
    return [tuple(re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line)) for line in re.findall(r"<tr>(.*?)</tr>", chart)]


@pytest.mark.parametrize(("interval", "bar"), [((1.5, 2.5), (1.5, 2.5)), (None, (None, None))])
def test_a_bar_is_an_interval_and_never_the_range_of_several_trainings(
    interval: tuple[float, float] | None, bar: tuple[float | None, float | None]
) -> None:
    value = Value(mean=2.0, low=1.0, high=3.0, std=None, seeds=3, interval=interval)
    point = point_of(4.0, Row(kind="measured", name="a", figures={"mse": value}), "mse")

    assert (point.x, point.y, point.low, point.high) == (4, 2, *bar)


def test_the_gain_is_drawn_on_a_linear_axis_below_zero_too_and_never_divided(budgeted: Budgeted) -> None:
    (board,) = make_boards(_entries(budgeted, "a", GAIN, -0.25, 0.25, 0.5))
    charts = _charts(board)

    assert [name for name in charts if name.endswith("gain captured")] == ["Label efficiency, gain captured"]
    chart = charts["Label efficiency, gain captured"]
    (x0, y0), (x1, y1), (x2, y2) = _line(chart, "a")
    assert x0 < x1 < x2
    assert y0 > y1 > y2  # upwards on the page is more
    assert (y0 - y1) / (y1 - y2) == pytest.approx(2, rel=0.01)  # a logarithm has no place for -0.25
    assert "Higher is better." in chart
    assert [line[2] for line in _numbers(chart)[1:]] == ["\u22120.250", "0.250", "0.500"]


def test_rollouts_are_drawn_plain_and_as_multiples_of_the_own_best_and_of_copying(budgeted: Budgeted) -> None:
    (board,) = make_boards(_entries(budgeted, "a", ROLLOUT, 12.0, 6.0, 2.0))
    charts = _charts(board)

    plain = charts["Label efficiency, MSE 15 ahead"]
    assert _numbers(plain) == [
        ("model", "labels", "MSE 15 ahead"),
        *(
            ("a", f"{labels} ({total})", value)
            for (labels, total), value in zip(BUDGETS, ("12.0", "6.00", "2.00"), strict=True)
        ),
    ]
    assert re.findall(r'class="name"[^>]*>([^<]*)', plain) == ["copy the last frame"]
    (_, y0), (_, y1), (_, y2) = _line(plain, "a")
    assert (y2 - y1) / (y1 - y0) == pytest.approx(1.585, rel=0.01)  # a factor of three to one of two
    for name, values in (
        ("Worth of labels, MSE 15 ahead", ["6.00", "3.00", "1.00"]),
        ("Label efficiency against copying, MSE 15 ahead", ["1.50", "0.750", "0.250"]),
    ):
        assert [line[2] for line in _numbers(charts[name])[1:]] == values


def test_a_figure_beside_the_errors_is_drawn_of_models_with_three_budgets(budgeted: Budgeted) -> None:
    few = _entries(budgeted, "b", GAIN, 0.1, 0.2)
    (board,) = make_boards([*_entries(budgeted, "a", GAIN, 0.1, 0.2, 0.3), *few])
    charts = _charts(board)
    assert "<title>b:" in charts["Label efficiency, MSE"]
    assert "<title>b:" not in charts["Label efficiency, gain captured"]
    (board,) = make_boards(few)
    assert "Label efficiency, gain captured" not in _charts(board)


def test_a_value_of_fewer_trainings_than_its_neighbours_says_so(budgeted: Budgeted) -> None:
    second = [budgeted("a", labels, total, 3.0, seed=1, **{GAIN: 0.5}) for labels, total in BUDGETS[:2]]
    (board,) = make_boards([*_entries(budgeted, "a", GAIN, 0.1, 0.3, 0.3), *second])
    charts = _charts(board)
    values = [line[2] for line in _numbers(charts["Label efficiency, gain captured"])[1:]]
    assert values == ["0.300", "0.400", "0.300 (1 of 2 trainings)"]
    assert "100% 1.00 (1 of 2 trainings)" in charts["Label efficiency, MSE"]


def test_a_training_that_was_scored_otherwise_is_in_no_curve_of_rollouts(budgeted: Budgeted) -> None:
    """A rollout of another length than most is not compared on a board: its curve keeps to what the board has."""
    first = _entries(budgeted, "a", ROLLOUT, 4.0, 2.0, 1.0)
    second = [budgeted("a", labels, total, 1.0, seed=1, **{ROLLOUT: 100.0}) for labels, total in BUDGETS]
    longer = [Entry(dict(one.content) | {"settings": one.content["settings"] | {"horizon": 99}}) for one in second]
    (board,) = make_boards([*first, *longer, *_entries(budgeted, "b", ROLLOUT, 4.0, 2.0, 1.0)])
    numbers = _numbers(_charts(board)["Label efficiency against copying, MSE 15 ahead"])
    assert [line[2] for line in numbers if line[0] == "a"] == ["0.500", "0.250", "0.125"]


def test_the_page_says_which_models_have_no_curve_and_what_is_not_drawn_over_labels(budgeted: Budgeted) -> None:
    alone = budgeted("b", "100%", 64, 1.0, **{"probe_mlp[action]": 0.9})
    curve = _entries(budgeted, "a", GAIN, 0.1, 0.2, 0.3)
    (board,) = make_boards([*curve, alone])
    said = label_notes(board)
    assert said.startswith("No curve over labels: b. A model that learns from actions is trained anew for each budget")
    assert "What probes read of a model of video does not depend on its labels" in said
    assert "Control is not measured over labels" in said
    assert said in make_page([*curve, alone])

    assert "No curve" not in label_notes(make_boards(curve)[0])
    assert "probes" not in label_notes(make_boards(curve)[0])
    assert label_notes(make_boards([alone])[0]) == ""
    (controlled,) = make_boards(_entries(budgeted, "a", "control_distance[40]", 0.9, 0.8, 0.7))
    assert "Control" not in label_notes(controlled)
    assert [line[2] for line in _numbers(_charts(controlled)["Label efficiency, control"])[1:]] == [
        "0.900",
        "0.800",
        "0.700",
    ]


def test_control_over_labels_is_drawn_with_the_tasks_and_the_board_of_the_training_says_where(
    budgeted: Budgeted, controlled: Budgeted
) -> None:
    def planned(model: str, asked: str, total: int, left: float) -> Entry:
        labels = {"asked": asked, "given": {}, "total": total}
        return controlled(model, np.full(len(TASK_EPISODES), left), column=HEADLINE.name, labels=labels)

    tasks = [planned("a", *budget, left) for budget, left in zip(BUDGETS, (0.9, 0.6, 0.3), strict=True)] + [
        planned("b", "one-shot", 4, 0.5)
    ]
    own = tasks[0].content["dataset"]["trained_on"]
    trained = [
        Entry({**one.content, "dataset": one.content["dataset"] | own})
        for one in _entries(budgeted, "a", GAIN, 0.1, 0.2, 0.3)
    ]
    boards = {board.dataset: board for board in make_boards([*tasks, *trained])}
    training, test = boards[own["name"]], boards[tasks[0].content["dataset"]["name"]]

    chart = _charts(test)[f"Label efficiency, control by the frozen planner {HEADLINE.title}"]
    (x0, y0), (x1, y1), (x2, y2) = _line(chart, "a")
    assert x0 < x1 < x2
    assert y1 - y0 == pytest.approx(y2 - y1, abs=0.2)  # a linear axis
    assert y2 > y0  # downwards on the page is less
    assert ("b", "one-shot (4)", "0.500") in _numbers(chart)  # beside it, a model with one budget
    assert f"Control over labels is drawn on the board of {test.dataset}." in label_notes(training, [training, test])
    assert "Control is not measured over labels" in label_notes(training)
    assert not [name for name in _charts(make_boards(tasks[1:])[0]) if "control" in name]
