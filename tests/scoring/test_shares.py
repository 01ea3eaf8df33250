"""Shares of which all cases are alike: their interval says that other cases were not met."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from dmotion_bench.scoring.differences import differences
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.samples import FIGURE_COLUMNS, PROBE, RANK_COLUMNS, SampleRows
from dmotion_bench.scoring.statistics import wilson
from leaderboard.comparison import figures_by_samples

EPISODES, STEPS = 12, 3
ALL, NONE = 1 - wilson(0, EPISODES)[1], wilson(0, EPISODES)[1]


def _samples(value: float, *, discrete: bool = True) -> pa.Table:
    """Single steps and rollouts whose every figure is the same number; all that probes are asked is read right."""
    episode = np.repeat(np.arange(EPISODES), STEPS)
    rows = len(episode)
    common = {"episode": episode, "step": np.tile(np.arange(STEPS), EPISODES)}
    alike = {name: np.full(rows, value, np.float32) for name in FIGURE_COLUMNS + RANK_COLUMNS}
    action = {"action": np.arange(rows) % 4} if discrete else {"command": np.ones((rows, 2))}
    probes = {f"{PROBE}action": np.tile([1.0, 0, 0, 1, 1, 1], (rows, 1))}
    tables = []
    for metric, columns in (("prediction", alike | action | probes), ("rollout", alike)):
        made = SampleRows(metric, "model")
        made.add(common | columns | {"ahead": np.ones(rows, np.int16), "pushed": np.ones(rows, np.bool_)})
        tables.append(made.table())
    return pa.concat_tables(tables)


@pytest.mark.parametrize(
    "figure",
    [
        "miss_rate",
        "miss_rate_push",
        "miss_rate_objects_push",
        "false_positive_rate_objects",
        "agent_iou",
        "motion_probe_accuracy",
        "inverse_accuracy",
        "rollout_miss_rate[1]",
        "rollout_hit_at_1[1]",
        "rollout_reciprocal_rank[1]",
    ],
)
def test_a_share_of_which_all_cases_are_alike_has_wilson_s_interval(figure: str) -> None:
    none, every = (figures_of(_samples(value), "model", resamples=100)[figure] for value in (0.0, 1.0))

    assert (none.mean, none.low, none.high) == pytest.approx((0, 0, NONE))
    assert (every.mean, every.low, every.high) == pytest.approx((1, ALL, 1))


def test_what_is_no_share_keeps_its_interval() -> None:
    found = figures_of(_samples(1.0), "model", resamples=100)

    assert {(found[name].low, found[name].high) for name in ("mse", "psnr", "position_error", "rollout_mse[1]")} == {
        (1.0, 1.0)
    }


def test_a_probe_that_reads_every_name_is_not_sure_of_others_and_one_of_numbers_has_no_bound() -> None:
    names, numbers = (
        figures_of(_samples(1.0, discrete=discrete), "model", resamples=100) for discrete in (True, False)
    )

    read, shuffled = "probe_linear[action]", "probe_linear_shuffled[action]"
    assert [(one.low, one.high) for one in (names[read], names[shuffled])] == [
        pytest.approx((ALL, 1)),
        pytest.approx((0, NONE)),
    ]
    assert (numbers[read].low, numbers[read].high) == (1, 1)


def test_an_entry_from_before_holds_with_its_interval_of_no_width() -> None:
    samples = _samples(np.float32(1 / 3))  # the mean is rounded, and so is the standard deviation
    now = figures_by_samples(samples, "model", {}, 100)["agent_iou"]
    before = now | {"low": now["mean"], "high": now["mean"]}

    assert now["low"] < now["mean"] < now["high"]
    assert figures_by_samples(samples, "model", {"agent_iou": before}, 100)["agent_iou"] == before


def test_two_models_that_find_all_and_none_may_differ_less_elsewhere() -> None:
    found = {one.figure: one for one in differences([_samples(1.0)], [_samples(0.0)])}

    for name in ("inverse_accuracy", "miss_rate_push", "rollout_hit_at_1[1]"):
        assert (found[name].difference.low, found[name].difference.high) == pytest.approx((1 - 2 * NONE, 1))
    assert found["inverse_accuracy"].verdict == "first"
    assert found["miss_rate"].verdict == "second"
    assert (found["mse"].difference.low, found["mse"].difference.high) == (1, 1)
