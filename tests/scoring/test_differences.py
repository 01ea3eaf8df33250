"""Which of two models is better, and differences of their shares of solved tasks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pytest

from dmotion_bench.scoring.differences import Difference, better, differences
from dmotion_bench.scoring.figures import ROLLOUT_COLUMNS
from dmotion_bench.scoring.samples import FIGURE_COLUMNS, OBJECT_COLUMNS, POSITION_COLUMNS, RANK_COLUMNS
from dmotion_bench.scoring.statistics import wilson
from dmotion_bench.scoring.trainings import difference_over_trainings

TASKS = 100
HIGHER = {"psnr", "ssim", "agent_iou", "motion_probe_accuracy", "inverse_accuracy", "hit_at_1", "reciprocal_rank"}
LOWER = {"mse", *POSITION_COLUMNS, *OBJECT_COLUMNS, "motion_shift_error", "motion_probe_error", "mse_true_motion"}


def test_of_each_figure_it_is_known_whether_higher_or_lower_is_better() -> None:
    found = {name: better(name, 0.1, 0.2) for name in FIGURE_COLUMNS + RANK_COLUMNS}

    assert {name for name, which in found.items() if which == "first"} == HIGHER
    assert {name for name, which in found.items() if which == "second"} == LOWER | {"inverse_error"}
    assert {name for name, which in found.items() if which is None} == {"motion_swap_change"}


@pytest.mark.parametrize(
    ("figure", "low", "high", "which"),
    [
        ("mse", -2.0, -1.0, "first"),
        ("mse", 1.0, 2.0, "second"),
        ("mse", -1.0, 2.0, None),
        ("mse", 0.0, 2.0, None),
        ("mse", None, None, None),
        ("ssim", 0.1, 0.2, "first"),
        ("psnr_push", -2.0, -1.0, "second"),
        ("control_success[0.2]", 0.1, 0.2, "first"),
        ("rollout_position_error[5]", 0.1, 0.2, "second"),
        ("motion_swap_change", 0.1, 0.2, None),
    ],
)
def test_better_is_said_only_where_the_interval_says_so(
    figure: str, low: float | None, high: float | None, which: str | None
) -> None:
    assert better(figure, low, high) == which


def _ended(solved: np.ndarray) -> pa.Table:
    """One step of control, each task in an episode of its own."""
    tasks = np.arange(len(solved))
    return pa.table(
        {
            "metric": ["control"] * len(tasks),
            "episode": tasks,
            "step": np.zeros(len(tasks)),
            "ahead": np.ones(len(tasks), np.int64),
            "task": tasks,
            "pushed": pa.nulls(len(tasks), pa.bool_()),
            "control_distance": np.where(solved, 0.1, 0.9),
            "control_lost": np.zeros(len(tasks)),
        }
    )


def _solved(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> Difference:
    found = differences(*([_ended(own) for own in model] for model in (first, second)))
    return next(one for one in found if one.figure == "control_success")


ALL, NONE, EVERY_OTHER = np.ones(TASKS, bool), np.zeros(TASKS, bool), np.arange(TASKS) % 2 == 0


@pytest.mark.parametrize("solved", [NONE, ALL, EVERY_OTHER])
@pytest.mark.parametrize("trainings", [1, 3])
def test_two_models_that_solve_the_same_tasks_may_differ_in_others(solved: np.ndarray, trainings: int) -> None:
    found = _solved([solved] * trainings, [solved])

    assert found.verdict == "tied"
    assert found.difference.mean == 0
    assert (found.difference.low, found.difference.high) == pytest.approx((-wilson(0, TASKS)[1], wilson(0, TASKS)[1]))


def test_all_against_none_is_better_and_not_for_certain() -> None:
    found, back = _solved([ALL], [NONE]), _solved([NONE], [ALL])

    assert (found.verdict, back.verdict) == ("first", "second")
    assert (found.difference.low, found.difference.high) == pytest.approx((1 - 2 * wilson(0, TASKS)[1], 1))
    assert (back.difference.low, back.difference.high) == pytest.approx((-1, 2 * wilson(0, TASKS)[1] - 1))


def test_the_interval_of_a_difference_of_shares_ends_at_1() -> None:
    """Of trainings that solve all and none: their distance from the mean, as a factor, is in the hundreds."""
    found = _solved([ALL, NONE], [NONE])

    assert (found.first, found.second, found.verdict) == (0.5, 0, "tied")
    assert (found.difference.low, found.difference.high) == (0, 1)


@pytest.mark.parametrize(("tasks", "only_first", "only_second"), [(20, 0.05, 0.0), (20, 0.1, 0.02), (100, 0.01, 0.0)])
def test_the_interval_of_a_difference_of_shares_covers_the_truth(
    tasks: int, only_first: float, only_second: float
) -> None:
    """Of few tasks that one model alone solves: in many draws there is none, and no interval of no width covers."""
    generator = np.random.default_rng(3)
    inside, trials = 0, 400
    for _ in range(trials):
        kind = generator.choice(3, tasks, p=[only_first, only_second, 1 - only_first - only_second])
        first, second = ((kind == which).astype(float)[None] for which in (0, 1))
        found = difference_over_trainings(first, second, np.ones(tasks), resamples=400).within(-1, 1)
        assert found.low is not None
        assert found.high is not None
        inside += found.low <= only_first - only_second <= found.high

    assert inside / trials >= 0.92


def test_ranks_among_other_rollouts_are_not_compared() -> None:
    def rolled_out(rollouts: int, value: float) -> pa.Table:
        places = np.arange(rollouts)
        return pa.table(
            {
                "metric": ["rollout"] * rollouts,
                "episode": places,
                "step": np.ones(rollouts),
                "ahead": np.ones(rollouts, np.int64),
                "pushed": pa.nulls(rollouts, pa.bool_()),
                **{name: np.full(rollouts, value) for name in ROLLOUT_COLUMNS},
            }
        )

    def compared(count: int) -> set[str]:
        return {one.figure for one in differences([rolled_out(6, 1.0)], [rolled_out(count, 0.5)])}

    every = {f"rollout_{name}[1]" for name in ROLLOUT_COLUMNS}
    ranks = {f"rollout_{name}[1]" for name in RANK_COLUMNS}
    assert compared(6) == every
    assert compared(8) == every - ranks
