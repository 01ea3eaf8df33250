"""Labels needed: found where a made-up curve has them, with an interval that follows episodes and trainings."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable

import numpy as np
import pytest

from leaderboard.board import make_boards
from leaderboard.board_tables import board_section
from leaderboard.curves import assign_styles, charts
from leaderboard.efficiency import WITHIN, CurvePoint, LabelsNeeded, crossing, labels_needed
from leaderboard.entry import Entry
from leaderboard.page import make_page

EPISODES, FRAMES = 30, 10


def _point(labels: int, errors: np.ndarray, *, is_all: bool = False, seeds: tuple[int, ...] = (0,)) -> CurvePoint:
    """``errors``: of each training and episode."""
    episodes = list(range(errors.shape[1]))
    sums = [{"episode": episodes, "n": [FRAMES] * len(episodes), "sum": (one * FRAMES).tolist()} for one in errors]
    return CurvePoint(labels=labels, is_all=is_all, sums=sums, seeds=seeds)


def _flat(labels: int, error: float, **more: object) -> CurvePoint:
    return _point(labels, np.full((1, EPISODES), error), **more)


@pytest.mark.parametrize(
    ("errors", "needed"),
    [
        ([8.0, 4.0, 2.0, 1.0], 64 * 2 ** (0.9 * 2)),  # 1.1 lies nine tenths of the way from 2 at 64 to 1 at 256
        ([8.0, 1.1, 1.05, 1.0], 16.0),
        ([1.0, 1.0, 1.0, 1.0], 4.0),
        ([8.0, 1.0, 8.0, 1.0], 64 * 2 ** (6.9 / 7 * 2)),  # coming close once is not staying close
        ([9.0, 9.0, 9.0, 9.0], 4.0),
    ],
)
def test_the_curve_crosses_where_it_is_drawn(errors, needed) -> None:
    assert crossing([4, 16, 64, 256], errors, 1.1 * errors[-1]) == pytest.approx(needed)


def test_a_curve_without_spread_has_its_own_crossing_as_its_interval() -> None:
    curve = [_flat(4, 8.0), _flat(16, 4.0), _flat(64, 2.0), _flat(256, 1.0, is_all=True)]
    found = labels_needed(curve[::-1])
    assert found is not None
    assert (found.labels, found.low, found.high) == pytest.approx((64 * 2**1.8,) * 3)
    assert not found.at_most
    closer = labels_needed(curve, within=1.0)
    assert closer is not None
    assert closer.labels == pytest.approx(64)


def test_what_is_close_from_the_start_may_need_fewer() -> None:
    found = labels_needed([_flat(1, 1.05), _flat(2, 1.0), _flat(400, 1.0, is_all=True)])
    assert found is not None
    assert found.at_most
    assert found.labels == 1


def test_the_interval_grows_with_the_spread_over_episodes_and_over_trainings() -> None:
    generator = np.random.default_rng(0)

    def width(over_episodes: float, over_trainings: float) -> float:
        points = []
        for labels, error in ((4, 3.0), (16, 2.0), (64, 1.0)):
            spread = 1 + over_episodes * generator.standard_normal((1, EPISODES))
            trainings = 1 + over_trainings * np.array([[-1.0], [0.0], [1.0]])
            errors = error * spread.clip(0.1) * trainings
            points.append(_point(labels, errors, is_all=labels == 64, seeds=(labels, labels + 1, labels + 2)))
        found = labels_needed(points)
        assert found is not None
        assert found.low is not None
        assert found.high is not None
        assert found.low <= found.labels <= found.high
        return found.high - found.low

    still = width(0.0, 0.0)
    assert still == pytest.approx(0, abs=1e-9)
    assert width(0.3, 0.0) > 1
    assert width(0.0, 0.3) > 1


def test_trainings_that_are_the_same_for_all_budgets_are_drawn_together() -> None:
    points = [
        _point(labels, error * np.array([[1.0], [5.0]]) * np.ones((2, EPISODES)), is_all=labels == 64, seeds=(0, 1))
        for labels, error in ((4, 3.0), (16, 2.0), (64, 1.0))
    ]
    found = labels_needed(points)  # a training that is five times worse is so at each budget: the shape is one
    assert found is not None
    assert found.low == pytest.approx(found.high)


def test_curves_that_do_not_compare_have_no_figure() -> None:
    whole = _flat(64, 1.0, is_all=True)
    assert labels_needed([whole]) is None
    assert labels_needed([_flat(4, 2.0), _flat(64, 1.0)]) is None
    assert labels_needed([_point(4, np.ones((1, EPISODES - 1))), whole]) is None


def test_the_page_draws_curves_of_three_budgets_and_says_what_is_needed(budgeted: Callable[..., Entry]) -> None:
    curve = [budgeted("a", "4", 4, 4.0), budgeted("a", "16", 16, 2.0), budgeted("a", "100%", 64, 1.0)]
    two_points = [budgeted("b", "10%", 6, 2.0), budgeted("b", "100%", 64, 1.0)]
    (board,) = make_boards([*curve, *two_points])
    drawn = str(charts(board, assign_styles([board])))
    assert drawn.count("labels to within 10% of its own with all") == 1
    assert "between 16 and all" in drawn
    assert "against copying" in drawn
    (board,) = make_boards(two_points)
    assert "Worth of labels" not in str(charts(board, assign_styles([board])))


def test_a_board_has_a_table_of_label_curves_with_the_budgets_that_most_of_them_have(
    budgeted: Callable[..., Entry],
) -> None:
    finer = [budgeted("a", str(count), count, 64.0 / count) for count in (4, 8, 16, 32)]
    coarser = [budgeted("b", str(count), count, error) for count, error in ((4, 9.5), (16, 1.05))]
    few = [budgeted("c", str(count), count, error) for count, error in ((16, 8.0), (20, 5.0))]
    whole = [budgeted(model, "100%", 64, 1.0) for model in ("a", "b", "c")]
    (board,) = make_boards([*finer, *coarser, *few, *whole])
    lines = board_section(board)
    place = next(number for number, line in enumerate(lines) if line.startswith("| Model | Labels needed |"))
    assert lines[place] == "| Model | Labels needed | Trainings | 4 | 16 | all |"
    assert lines[place + 2 : place + 4] == [
        "| a | between 16 and all | 1 | 16.0 | 4.00 | 1.00 |",  # 32 is no budget of most models
        "| b | between 4 and 16 | 1 | 9.50 | 1.05 | 1.00 |",
    ]
    assert lines[place + 4] == "| c | not comparable | 1 | | 8.00 | 1.00 |"  # it lacks one of two
    assert "with fewer than three of the table's budgets is not comparable" in " ".join(lines)
    measured = [line for line in lines[:place] if line.startswith(("| a |", "| b |", "| c |"))]
    assert len(measured) == 3  # a number of labels has its place in that table alone
    assert "Labels needed" not in "".join(board_section(make_boards(whole)[0]))


def test_what_a_model_needs_is_said_by_the_budgets_that_were_measured() -> None:
    def words(labels: float, low: float | None = None, high: float | None = None) -> str:
        return LabelsNeeded(labels=labels, low=low, high=high, budgets=(4, 10, 64)).words

    assert words(4.0) == "at most 4"
    assert words(7.1) == words(10.000000000000002) == words(7.1, 5.0, 9.9) == "between 4 and 10"
    assert words(11.0, 5.0, 60.0) == "between 10 and all (4 to all)"
    assert words(7.1, 4.0, 9.0) == "between 4 and 10 (at most 4 to 10)"


def test_a_model_that_is_worse_than_copying_with_all_labels_needs_no_number(budgeted: Callable[..., Entry]) -> None:
    def cells(level: float) -> list[str]:
        entries = [budgeted("a", str(count), count, level) for count in (4, 16)]
        (board,) = make_boards([*entries, budgeted("a", "100%", 64, level)])
        return [line for line in board_section(board) if line.startswith("| a | at most 4 |")]

    copied = make_boards([budgeted("a", "100%", 64, 1.0)])[0].reference("copy_last")["mse"].mean
    assert cells(copied * 0.99)
    assert not cells(copied * 1.01)


def test_a_label_curve_is_of_the_same_trainings_under_every_budget(budgeted: Callable[..., Entry]) -> None:
    def trained(labels: str, total: int, errors: dict[int, float]) -> list[Entry]:
        return [budgeted("a", labels, total, error, seed=seed) for seed, error in errors.items()]

    few, some = trained("4", 4, {0: 8.0, 1: 4.0}), trained("16", 16, {0: 3.0})

    def line(whole: list[Entry]) -> str:
        (board,) = make_boards([*few, *some, *whole])
        return next(line for line in board_section(board) if re.match(r"\| a \| (between|at most)", line))

    assert line(trained("100%", 64, {0: 3.0, 1: 1.0})) == "| a | between 4 and 16 | 1 | 8.00 | 3.00 | 3.00 |"
    assert line(trained("100%", 64, {1: 1.0})).endswith("| 2 | 6.00 | 3.00 (1 of 2) | 1.00 (1 of 2) |")


def test_of_many_budgets_the_table_has_every_second_one(budgeted: Callable[..., Entry]) -> None:
    points = [budgeted("a", str(2**power), 2**power, 2.0 ** (14 - power)) for power in range(13)]
    (board,) = make_boards([*points, budgeted("a", "100%", 9000, 1.0)])
    (head,) = (line for line in board_section(board) if line.startswith("| Model | Labels needed |"))
    assert head == "| Model | Labels needed | Trainings | 1 | 4 | 16 | 64 | 256 | 1,024 | 4,096 | all |"


def test_demonstrations_of_each_action_are_no_points_of_a_curve_of_numbers(budgeted: Callable[..., Entry]) -> None:
    numbered = [budgeted("a", labels, total, error) for labels, total, error in (("4", 4, 4.0), ("16", 16, 2.0))]
    whole, shown = budgeted("a", "100%", 64, 1.0), budgeted("a", "one-shot", 4, 1.5)

    def curve(*entries: Entry) -> list[str]:
        ((_, rows),) = make_boards(entries)[0].label_curves.items()
        return [row.labels for row in rows]

    assert curve(*numbered, shown, whole) == ["4", "16", "100%"]
    assert curve(numbered[0], shown, whole) == ["one-shot", "4", "100%"]  # too few numbers for a curve without it


def test_the_page_draws_what_is_read_of_the_action_against_the_most_of_the_rest(sound: Entry) -> None:
    def entry(model: str, **read: float) -> Entry:
        figures = {name.replace("_OF_", "[") + "]": value for name, value in read.items()}
        probes = {
            name: {"mean": value, "std": 0.1, "low": value, "high": value, "n": 9} for name, value in figures.items()
        }
        made = copy.deepcopy(dict(sound.content))
        return Entry(made | {"model": model, "run": f"{model}-s0", "figures": made["figures"] | probes})

    told = entry(
        "a",
        probe_mlp_OF_action=0.9,
        probe_mlp_shuffled_OF_action=0.25,
        probe_mlp_OF_movers=0.125,
        probe_mlp_OF_camera=0.5,
    )
    (board,) = make_boards([told, entry("b", probe_mlp_OF_action=0.75)])
    drawn = str(charts(board, assign_styles([board])))
    (chart,) = re.findall(r"<figure>(?:(?!</figure>).)*What the latent action holds.*?</figure>", drawn, re.DOTALL)
    assert "a, labels one-shot: action 0.900, camera 0.500" in chart
    assert re.findall(r'class="name"[^>]*>([^<]*)', chart) == ["chance"]
    assert "<td>camera</td>" in chart
    assert "b, labels" not in chart  # of whose world nothing else is known
    (board,) = make_boards([entry("b", probe_mlp_OF_action=0.75)])
    assert "What the latent action holds" not in str(charts(board, assign_styles([board])))


def test_the_page_folds_the_points_of_curves_away_and_keeps_every_entry(budgeted: Callable[..., Entry]) -> None:
    points = [budgeted("a", labels, total, error) for labels, total, error in (("4", 4, 4.0), ("16", 16, 2.0))]
    rest = [budgeted("a", "100%", 64, 1.0), budgeted("b", "16", 16, 3.0)]
    page = make_page([*points, *rest])
    table, _, folded = page.partition("<summary>The label curves&#x27; points: 2 more rows")
    assert folded
    shown = table[table.index('class="standings"') :]
    labels = r"<td[^>]*>(\d+)<small>(?:100%|any actions)</small>"
    assert re.findall(labels, shown) == ["64", "16"]  # b has no curve
    inside = folded[: folded.index("</details>")]
    assert re.findall(labels, inside) == ["16", "4"]
    for entry in (*points, *rest):
        assert f'href="#{entry.slug}"' in page
        assert f'id="{entry.slug}"' in page


@pytest.mark.slow
@pytest.mark.parametrize("same", [True, False], ids=["the same trainings", "others for each budget"])
def test_the_interval_covers_the_truth_with_three_trainings(same: bool) -> None:
    generator = np.random.default_rng(1)
    labels, errors = (16, 64, 256, 1024), (2.0, 1.5, 1.12, 1.0)
    truth, episodes, trials = crossing(labels, errors, (1 + WITHIN) * errors[-1]), 60, 60

    def point(place: int, level: np.ndarray, factors: np.ndarray) -> CurvePoint:
        drawn = [level * errors[place] * factor * (1 + 0.05 * generator.normal(size=episodes)) for factor in factors]
        sums = [{"episode": [*range(episodes)], "n": [30] * episodes, "sum": one.tolist()} for one in drawn]
        seeds = [0, 1, 2] if same else [10 * place + number for number in range(3)]
        return CurvePoint(labels=labels[place], is_all=place == len(labels) - 1, sums=sums, seeds=seeds)

    covered = 0
    for _ in range(trials):
        level, factors = 30 * generator.gamma(4.0, 0.25, episodes), 1 + 0.1 * generator.normal(size=(4, 3))
        found = labels_needed([point(place, level, factors[0 if same else place]) for place in range(len(labels))])
        assert found is not None
        assert found.low is not None
        assert found.high is not None
        covered += found.low <= truth <= found.high
    assert covered >= 0.9 * trials
