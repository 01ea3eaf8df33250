"""Imagined images update what is believed as real ones do, and what vanishes is lost where video says so."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from planning.boxes import AT, FIRST, SPEC, picture
from planning.test_tracked_risk import GOAL, LEFT, Shown

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.choices import make_objective
from dmotion_bench.planning.objectives.base import CostState, StepCost, taught
from dmotion_bench.planning.objectives.centres import Centres
from dmotion_bench.planning.objectives.tracked_belief import TaughtBelief, TrackedBelief, TrackedBeliefEvaluator
from dmotion_bench.planning.objectives.vanishing import Vanishings
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset

HIDDEN = picture(red=None)
"""The red box is not to be seen."""


def judge(gone: Sequence[bool] = (False,) * 50, goal: tuple[int, int] = GOAL) -> TrackedBeliefEvaluator:
    """At work on a task whose goal is the red box elsewhere, where things that vanished stayed away, or not."""
    places = torch.tensor([[*map(float, AT)]] * len(gone)).reshape(-1, 2)
    known = Vanishings(place=places, gone=torch.tensor(gone, dtype=torch.bool), width=2.0)
    taught_one = TaughtBelief(settings=TrackedBelief(), vanishings=known)
    return taught_one.reset(SPEC, picture().numpy(), picture(red=goal).numpy())


def imagined(of: TrackedBeliefEvaluator, *frames: torch.Tensor) -> StepCost:
    """The cost of the last of some frames that are imagined one after the other."""
    dynamics = Shown()
    carried: CostState = of.begin(dynamics)
    for frame in frames:
        cost, carried = of.step(dynamics, (frame,), FIRST, FIRST, carried)
    assert cost.total.item() == pytest.approx(cost.distance.item() + cost.risk.item())
    return cost


def test_what_is_hidden_in_an_imagined_image_is_where_it_was_imagined_last() -> None:
    halfway = (AT[0] + 12, AT[1])
    cost = imagined(judge(), picture(red=halfway), HIDDEN)
    assert cost.distance.item() == pytest.approx(12**2)
    assert imagined(judge(), HIDDEN).distance.item() == pytest.approx(LEFT)
    assert imagined(judge(), picture(red=GOAL), HIDDEN, HIDDEN).total.item() == pytest.approx(0, abs=1e-3)


def test_a_part_of_it_is_held_against_where_it_was_imagined_last() -> None:
    moved = (AT[0] + 12, AT[1])
    behind = picture(red=moved, curtain=slice(moved[0], 60))  # its left half is to be seen
    assert imagined(judge(), picture(red=moved), behind).distance.item() == pytest.approx(12**2)


def test_what_vanishes_where_things_stay_away_costs_as_much_as_all_objects_at_the_start() -> None:
    of, near = judge(gone=[True] * 50, goal=(44, 20)), picture(red=(AT[0] + 2, AT[1]))
    cost = imagined(of, near, HIDDEN)
    assert cost.distance.item() == pytest.approx(22**2 + 10**2)
    assert cost.total.item() == pytest.approx(24**2 + 10**2)
    farther = imagined(of, picture(red=(AT[0] - 2, AT[1])), HIDDEN)
    assert farther.risk.item() == 0  # where it is believed is no better


def test_the_chance_is_that_of_the_place() -> None:
    mixed = imagined(judge(gone=[True, False] * 25), picture(red=(AT[0] + 2, AT[1])), HIDDEN)
    assert mixed.risk.item() == pytest.approx((LEFT - 22**2) / 2, rel=1e-3)
    assert imagined(judge(), picture(red=(AT[0] + 2, AT[1])), HIDDEN).risk.item() == 0


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_what_is_imagined_again_is_hardly_lost_by_bayes_rule(share: float) -> None:
    of = judge(gone=[number < 50 * share for number in range(50)])
    back, whole = picture(red=(AT[0] + 2, AT[1])), LEFT - 22**2
    after = 0.05 * share / (0.05 * share + 1 - share)
    assert imagined(of, back, HIDDEN).risk.item() == pytest.approx(whole * share, rel=1e-3)
    assert imagined(of, back, HIDDEN, HIDDEN).risk.item() == pytest.approx(whole * share, rel=1e-3)
    assert imagined(of, back, HIDDEN, back).risk.item() == pytest.approx(whole * after, rel=1e-3)
    assert imagined(of, back, HIDDEN, back, back).risk.item() == pytest.approx(whole * after, rel=1e-3)
    assert imagined(of, back, HIDDEN, back, HIDDEN).risk.item() == pytest.approx(whole * share, rel=1e-3)


def test_what_certainly_stays_away_is_lost_although_it_is_imagined_again() -> None:
    of, back = judge(gone=[True] * 50), picture(red=(AT[0] + 2, AT[1]))
    assert imagined(of, back, HIDDEN, back).risk.item() == pytest.approx(LEFT - 22**2, rel=1e-3)


def test_what_real_images_hide_was_not_lost_by_an_action() -> None:
    of = judge(gone=[True] * 50)
    of.observe(FIRST.numpy(), HIDDEN.numpy())
    cost = imagined(of, HIDDEN)
    assert cost.distance.item() == pytest.approx(LEFT)
    assert cost.risk.item() == 0


def test_each_row_has_its_own_belief() -> None:
    of, dynamics = judge(), Shown()
    (carried, rows) = (of.begin(dynamics), torch.zeros(2, dtype=torch.long))
    both = torch.cat([picture(red=GOAL), picture()])
    _, after = of.step(dynamics, (both,), rows, rows, tuple(one[rows] for one in carried))
    cost, _ = of.step(dynamics, (HIDDEN.expand(2, -1, -1, -1),), rows, rows, after)
    assert cost.distance.tolist() == pytest.approx([0, LEFT], abs=1e-3)


def test_an_object_of_which_nothing_is_known_costs_as_much_as_a_lost_one() -> None:
    known = Vanishings(place=torch.zeros(0, 2), gone=torch.zeros(0, dtype=torch.bool), width=1.0)
    taught_one = TaughtBelief(settings=TrackedBelief(), vanishings=known)
    of = taught_one.reset(SPEC, picture().numpy(), picture(red=GOAL).numpy())
    of.known.centre[0, 0] = float("nan")
    assert imagined(of, HIDDEN).distance.item() == pytest.approx(LEFT)


@pytest.mark.slow
def test_it_learns_from_video_before_it_is_used_and_reads_no_label(tmp_path: Path) -> None:
    objective = make_objective("tracked-belief", ["lost_below=0.2"])
    assert objective == TrackedBelief(lost_below=0.2)
    frame = picture().numpy()
    with pytest.raises(InvalidSetting, match="learns from video first"):
        objective.reset(SPEC, frame, frame)
    plain = Centres()
    record_dataset(tmp_path / "tiny", recipe_for("planar_push", Preset.TINY))
    dataset = Dataset.open(tmp_path / "tiny")
    assert taught(plain, dataset) is plain
    known = taught(objective, dataset)
    assert isinstance(known, TaughtBelief)
    assert known.settings == objective
    twice = taught(objective, dataset)
    assert isinstance(twice, TaughtBelief)
    assert twice.vanishings is known.vanishings
    shutil.rmtree(dataset.path / "labels")
    again = TrackedBelief(lost_below=0.2, box_margin_px=2).learned(dataset)
    assert torch.equal(again.vanishings.place, known.vanishings.place)
