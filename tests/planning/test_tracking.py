"""Objects are followed by pictures alone, also where something passes in front of them."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, SETTINGS, SPEC, picture

from dmotion_bench.planning.objectives.centres import CentresEvaluator
from dmotion_bench.planning.objectives.tracked import Tracked, TrackedEvaluator
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker


@pytest.fixture
def tracker() -> Tracker:
    return Tracker(SPEC, SETTINGS)


def red(known: BoundingBoxes) -> list[float]:
    centre: list[float] = known.centre[0, 0].tolist()
    return centre


@pytest.mark.parametrize("curtain", [slice(0, 20), slice(21, 40), slice(18, 30), slice(10, 17)])
def test_what_passes_in_front_of_an_object_does_not_move_it(tracker: Tracker, curtain: slice) -> None:
    known = tracker.look(picture())
    covered = picture(curtain=curtain)
    assert abs(red(tracker.look(covered))[0] - AT[0]) >= 1
    assert red(tracker.update(known, covered)) == pytest.approx(AT)


def test_an_object_that_is_hidden_stays_where_it_was_and_comes_back_where_it_is(tracker: Tracker) -> None:
    known = tracker.look(picture())
    hidden = tracker.update(known, picture(curtain=slice(10, 40)))
    assert red(hidden) == pytest.approx(AT)
    assert hidden.seen.tolist() == [[False, True]]
    assert red(tracker.update(hidden, picture(red=(24, 31)))) == pytest.approx((24, 31))


def test_a_half_hidden_object_moves_as_far_as_its_visible_half_tells(tracker: Tracker) -> None:
    known = tracker.look(picture())
    pushed = tracker.update(known, picture(red=(28, 30), curtain=slice(10, 28)))
    assert red(pushed) == pytest.approx((28, 30), abs=1)  # its right edge is seen
    unsure = tracker.update(known, picture(red=(28, 30), curtain=slice(26, 50)))
    assert red(unsure) == pytest.approx(AT)  # its left edge is still within the outline: it may be at rest


def test_the_start_helps_with_the_goal_and_the_goal_with_the_start(tracker: Tracker) -> None:
    clear, covered = picture(), picture(curtain=slice(20, 40))
    for first, last in ((clear, covered), (covered, clear)):
        here, there = tracker.meet(first, last)
        assert red(here) == pytest.approx(AT)
        assert red(there) == pytest.approx(AT)


def test_each_row_of_a_batch_is_its_own(tracker: Tracker) -> None:
    frames = torch.cat([picture(), picture(red=(40, 12)), picture(red=None)])
    known = tracker.look(frames)
    order = torch.tensor([2, 1, 0, 1])
    together = tracker.believed(known.of(order), tracker.look(frames[order]))
    for place, row in enumerate(order.tolist()):
        alone = tracker.update(tracker.look(frames[row : row + 1]), frames[row : row + 1])
        torch.testing.assert_close(together.centre[place], alone.centre[0], equal_nan=True)


def test_the_cost_is_the_papers_where_all_is_seen_and_does_not_fall_behind_a_curtain(tracker: Tracker) -> None:
    start, goal = picture(), picture(red=(40, 30))
    papers, tracked = CentresEvaluator(SPEC, goal, 32.0), TrackedEvaluator(SPEC, start, goal, Tracked())
    for place in ((20, 30), (33, 41), (40, 30)):
        frame = picture(red=place)
        assert tracked.of_boxes(tracker.look(frame), FIRST).item() == pytest.approx(
            papers.of_frames(frame, FIRST).item()
        )
    behind = picture(curtain=slice(10, 20))  # the left half is hidden: the visible centre is nearer to the goal
    assert papers.of_frames(behind, FIRST).item() < 0.9 * papers.of_frames(start, FIRST).item()
    assert tracked.of_boxes(tracker.look(behind), FIRST).item() == pytest.approx(400)
    gone = tracked.of_boxes(tracker.look(picture(red=None)), FIRST).item()
    assert gone == pytest.approx(32**2)  # it is seen now and not then: it may be lost
