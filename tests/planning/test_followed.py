"""What is imagined is followed step by step: smears and stray pixels neither make nor unmake objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from planning.boxes import AT, FIRST, RED, SETTINGS, SPEC, on_a_table, picture
from planning.worlds import PerfectGridModel, observed

from dmotion_bench.planning.choices import default_objective
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.objectives.base import PARTS
from dmotion_bench.planning.objectives.centres import CentresEvaluator
from dmotion_bench.planning.objectives.tabletop.followed import FollowedObjects
from dmotion_bench.planning.objectives.tabletop.objective import Tabletop, TabletopEvaluator
from dmotion_bench.planning.objectives.tracked import Tracked, TrackedEvaluator
from dmotion_bench.planning.objectives.tracking import Tracker
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.specs import EnvSpec
from recorders.grid_things import FACTS, draw

GOAL = (44, 30)
MAY_BE_LOST = SETTINGS.fall_unlikely * (SETTINGS.lost_distance * SPEC.width) ** 2
BELOW = int(SETTINGS.least_gain * SPEC.width) ** 2


def cost_of(spec: EnvSpec = SPEC) -> FollowedObjects:
    tracker = Tracker(spec, SETTINGS)
    return FollowedObjects(SETTINGS, spec, *tracker.meet(picture(), picture(red=GOAL)))


def followed(*frames: torch.Tensor) -> list[float]:
    """What each of some pictures costs that come one after the other."""
    cost, prices = cost_of(), []
    known = cost.begin()
    for frame in frames:
        price, known = cost.of_frames(frame, FIRST, FIRST, known)
        prices.append(price.total.item())
    return prices


@pytest.mark.parametrize("step", [4, 24])
def test_the_cost_is_the_papers_where_all_is_seen(step: int) -> None:
    frames = [picture(red=(x, 30)) for x in range(AT[0], GOAL[0] + 1, step)]
    papers = CentresEvaluator(SPEC, picture(red=GOAL), 32.0)
    assert followed(*frames) == pytest.approx([papers.of_frames(frame, FIRST).item() for frame in frames])


def test_stray_pixels_near_the_goal_are_no_object() -> None:
    frame = picture()
    frame[0, 25:36, 38:50] = torch.tensor(RED, dtype=torch.uint8)
    frame[0, 30, 44] = 0  # as many pixels as the object has, and they lie around the goal
    assert CentresEvaluator(SPEC, picture(red=GOAL), 32.0).of_frames(frame, FIRST).item() < 12.5**2
    assert followed(frame) == pytest.approx([24**2])


def test_an_object_that_fades_away_stays_where_it_was_imagined_last() -> None:
    gone = picture(red=None)
    prices = followed(picture(red=(24, 30)), picture(red=(28, 30)), gone, gone)
    assert prices == pytest.approx([20**2, 16**2, 16**2, 16**2])
    tracked = TrackedEvaluator(SPEC, picture(), picture(red=GOAL), Tracked())
    assert tracked.of_boxes(Tracker(SPEC, SETTINGS).look(gone), FIRST).item() == 32**2


def test_an_object_that_the_first_step_lacks_may_be_lost_and_does_not_come_back() -> None:
    sliver = picture(curtain=slice(16, 40))
    assert followed(picture(red=None), picture(red=GOAL)) == pytest.approx([24**2 + MAY_BE_LOST, MAY_BE_LOST])
    assert followed(sliver, picture(red=GOAL))[1] == pytest.approx(MAY_BE_LOST)
    assert followed(picture(), picture(red=None), picture(red=GOAL)) == pytest.approx([24**2, 24**2, 0])


def test_what_the_arm_hides_at_the_start_is_not_lost() -> None:
    tracker = Tracker(SPEC, SETTINGS)
    known = tracker.update(tracker.look(picture()), hidden := picture(curtain=slice(10, 30)))
    cost = FollowedObjects(SETTINGS, SPEC, known, tracker.look(picture(red=GOAL)))
    assert cost.of_frames(hidden, FIRST, FIRST, cost.begin())[0].total.item() == pytest.approx(24**2)


@pytest.mark.parametrize("curtain", [slice(10, 20), slice(20, 40), slice(10, 24)])
def test_a_curtain_moves_nothing(curtain: slice) -> None:
    assert followed(picture(curtain=curtain)) == pytest.approx([24**2])


def test_less_than_a_pixel_is_no_movement() -> None:
    narrower = picture()
    narrower[0, :, 15] = 0
    tracker = Tracker(SPEC, SETTINGS)
    known, wanted = tracker.meet(picture(), picture(red=GOAL))
    for still, price in ((0.4, 23.5**2), (0.6, 24**2)):
        cost = FollowedObjects(replace(SETTINGS, still_px=still, least_gain=0.0), SPEC, known, wanted)
        assert cost.of_frames(narrower, FIRST, FIRST, cost.begin())[0].total.item() == pytest.approx(price)


def test_a_little_better_is_no_better_but_a_touch_for_nothing_is_worse() -> None:
    tracker = Tracker(SPEC, SETTINGS)
    near, goal = picture(red=(42, 30)), picture(red=GOAL)
    cost = FollowedObjects(SETTINGS, SPEC, *tracker.meet(near, goal))
    for place, price in (((42, 30), 4), ((43, 30), 4), ((41, 30), 9), ((40, 30), 16), ((38, 30), 36)):
        found = cost.of_frames(picture(red=place), FIRST, FIRST, cost.begin())[0].total.item()
        touch = min(abs(place[0] - 42) / (SETTINGS.touch_distance * SPEC.width), 1) * BELOW
        assert found == pytest.approx(4 + touch if abs(price - 4) < BELOW else price)


def test_each_row_has_its_own_task_and_its_own_past() -> None:
    starts, goals = torch.cat([picture(), picture(red=(30, 12))]), torch.cat([picture(red=GOAL), picture()])
    tracker = Tracker(SPEC, SETTINGS)
    known, wanted = tracker.meet(starts, goals)
    cost = FollowedObjects(SETTINGS, SPEC, known, wanted)
    task = torch.tensor([1, 0, 1])
    frames = torch.cat([picture(red=(33, 14)), picture(red=(23, 30)), picture(red=None)])
    past = cost.begin()[task] + F.pad(torch.tensor([[[2.0, 1.0]], [[1.0, 0.0]], [[0.0, 3.0]]]), (0, 2))
    past[2, :, 2] = torch.tensor([1.0, 0.0])
    prices, after = cost.of_frames(frames, task, task, past)
    for row, of in enumerate(task.tolist()):
        alone = FollowedObjects(SETTINGS, SPEC, known.of(torch.tensor([of])), wanted.of(torch.tensor([of])))
        price, place = alone.of_frames(frames[row : row + 1], FIRST, FIRST, past[row : row + 1])
        torch.testing.assert_close(prices.total[row], price.total[0])
        torch.testing.assert_close(after[row], place[0])


@pytest.mark.slow
def test_a_tree_remembers_what_was_followed() -> None:
    places = np.array([[(0, 0), (1, 1), (3, 1), (1, 3), (3, 3)], [(0, 1), (1, 2), (3, 1), (1, 3), (3, 3)]])
    start, goal = torch.from_numpy(draw(places, np.ones((2, 5), np.bool_))[0]).split(1)
    model = PerfectGridModel()
    evaluator = Tabletop().reset(FACTS, start.numpy(), goal.numpy())
    dynamics = ModelDynamics(model, bf16=False)
    tree = PrefixTree(dynamics, evaluator, observed(start), 3)
    sequences = np.array([[[3, 1, 0], [3, 1, 1], [1, 3, 0], [0, 0, 1]]])
    found = tree.costs(sequences)
    for place, actions in enumerate(sequences[0]):
        state, carried = dynamics.start(observed(start)), evaluator.begin(dynamics)
        for step, action in enumerate(actions.tolist()):
            chosen = torch.tensor([action])
            state = dynamics.step(state, chosen)
            price, carried = evaluator.step(dynamics, state, FIRST, chosen, carried)
            assert found[0, place, step] == pytest.approx(price.total.item())
            parts = tree.parts(sequences[:, place : place + 1], np.array([[step]]))
            assert {name: values.item() for name, values in parts.items()} == {
                name: pytest.approx(getattr(price, name).item()) for name in PARTS
            }
    assert found.min() == pytest.approx(0, abs=16)  # right, then down: the circle is pushed to its place


def test_the_parts_of_the_cost_add_up() -> None:
    left = AT[0] - 2
    start, goal = on_a_table(picture(curtain=slice(56, 60)), left), on_a_table(picture(red=GOAL), left)
    evaluator = TabletopEvaluator(SETTINGS, SPEC, start, goal)
    evaluator.observe(np.array([1]), on_a_table(picture(curtain=slice(50, 54)), left).numpy())
    cost = evaluator.now(torch.device("cpu"))
    known, seen = cost.begin(), []
    for frame in (picture(red=None), picture(red=(24, 30)), picture(red=(22, 30), curtain=slice(0, 4)), picture()):
        price, known = cost.of_frames(on_a_table(frame, left), FIRST, FIRST, known)
        seen.append(price)
        assert price.total.item() == pytest.approx((price.distance + price.risk - price.bonus).item(), rel=1e-5)
    assert seen[0].risk.item() == pytest.approx(SETTINGS.fall_likely * (SETTINGS.lost_distance * SPEC.width) ** 2)
    assert any(price.bonus.item() > 0 for price in seen)
    assert seen[1].distance.item() == pytest.approx(20**2)


def test_it_is_chosen_by_name_and_the_environment_names_what_suits_it() -> None:
    shaded = replace(FACTS, shaded=True)
    assert default_objective("robot_push", shaded, needs_pixels=True) == "tabletop"
    assert default_objective("grid_world", FACTS, needs_pixels=True) == "tracked"
    assert default_objective("grid_world", shaded, needs_pixels=True) == "tracked"  # light switches nothing on
    assert default_objective("robot_push", shaded, needs_pixels=False) == "feature"
    assert default_objective("robot_push", replace(shaded, objects=()), needs_pixels=True) == "feature"
