"""What stands at the table's edge is watched, and a first step that leaves too little of it is as bad as a fall."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, SPEC, picture
from planning.worlds import PerfectGridModel

from dmotion_bench.planning.costs import make_cost
from dmotion_bench.planning.covering import Ground
from dmotion_bench.planning.edges import MARGIN, SURE, Edges
from dmotion_bench.planning.exploring import Sights
from dmotion_bench.planning.following import LOSS, FollowedCost
from dmotion_bench.planning.tracking import Tracker

TABLE = torch.tensor([200, 180, 150], dtype=torch.uint8)
LOST = (LOSS * SPEC.width) ** 2


def on_a_table(frame: torch.Tensor, left: int = 0, top: int = 0) -> torch.Tensor:
    """The picture with a table under the boxes that begins at a column and a row, the rest of the ground black."""
    black = (frame == 0).all(-1)
    black[:, :top] = black[:, :, :left] = False
    table = frame.clone()
    table[black] = TABLE
    return table


def edges(left: int = 0, top: int = 0, **start: object) -> Edges:
    frame = on_a_table(picture(**start), left, top)
    tracker = Tracker(SPEC)
    known = tracker.look(frame)
    return Edges(tracker, Ground(tracker, frame, known), frame, frame, known)


def in_danger(of: Edges, frame: torch.Tensor) -> list[bool]:
    return of.in_danger(frame, Tracker(SPEC).look(frame), FIRST, torch.ones((1, 2), dtype=torch.bool))[0].tolist()


NEAR = int(MARGIN * SPEC.width)
NOTHING = {"red": None, "blue": None}


def smeared(left: int = 0, rows: slice = slice(AT[1] - 5, AT[1] + 6)) -> torch.Tensor:
    """Something as bright as the curtain where the red box was, in some rows only."""
    frame = on_a_table(picture(red=None), left)
    frame[:, rows, AT[0] - 5 : AT[0] + 6] = 250
    return frame


@pytest.mark.parametrize(
    ("left", "top", "watched"),
    [
        (AT[0] - NEAR + 1, 0, True),
        (AT[0] - NEAR - 1, 0, False),
        (0, AT[1] - NEAR + 1, True),
        (0, AT[1] - NEAR - 1, False),
        (AT[0] - 1, 0, True),
    ],
)
def test_an_object_near_an_edge_is_watched(left: int, top: int, watched: bool) -> None:
    assert in_danger(edges(left, top), on_a_table(picture(**NOTHING), left, top)) == [watched, False]


@pytest.mark.parametrize("share", [SURE - 0.1, SURE + 0.1])
def test_how_much_of_it_is_left_decides(share: float) -> None:
    frame = on_a_table(picture(), AT[0] - 2)
    frame[:, AT[1] - 5 + round(11 * share) : AT[1] + 6, : AT[0] + 6] = TABLE
    assert in_danger(edges(AT[0] - 2), frame) == [share < SURE, False]


def test_what_passes_before_it_reaches_below_it_and_a_smear_does_not() -> None:
    left = AT[0] - 2
    passing = on_a_table(picture(curtain=slice(AT[0], AT[0] + 9)), left)
    assert in_danger(edges(left), smeared(left)) == [True, False]
    assert in_danger(edges(left), passing) == [False, False]
    assert in_danger(edges(left), smeared(left, slice(AT[1] - 5, AT[1] + 7))) == [True, False]
    assert in_danger(edges(left), smeared(left, slice(AT[1] - 5, AT[1] + 10))) == [False, False]


def test_what_stood_below_it_before_passes_nothing() -> None:
    """The curtain is there already; a box of which a third more is lost is in danger."""
    curtain = slice(AT[0] + 2, AT[0] + 9)
    frame = on_a_table(picture(red=None, curtain=curtain), AT[0] - 2)
    assert in_danger(edges(AT[0] - 2, curtain=curtain), frame) == [True, False]
    same = on_a_table(picture(curtain=curtain), AT[0] - 2)
    assert in_danger(edges(AT[0] - 2, curtain=curtain), same) == [False, False]


def test_the_goal_shows_ground_that_the_agent_hides_now() -> None:
    """A curtain over the left of the table is not its edge."""
    curtain = slice(0, AT[0] - 2)
    frame, goal = on_a_table(picture(curtain=curtain)), on_a_table(picture())
    tracker = Tracker(SPEC)
    known = tracker.follow(tracker.look(goal), frame)
    ground = Ground(tracker, frame, known)
    gone = on_a_table(picture(red=None, curtain=curtain))
    assert in_danger(Edges(tracker, ground, frame, frame, known), gone) == [True, False]
    assert in_danger(Edges(tracker, ground, frame, goal, known), gone) == [False, False]


def test_only_what_is_asked_about_is_in_danger() -> None:
    gone = on_a_table(picture(red=None), AT[0] - 2)
    nobody = torch.zeros((1, 2), dtype=torch.bool)
    assert not edges(AT[0] - 2).in_danger(gone, Tracker(SPEC).look(gone), FIRST, nobody).any()


def test_where_no_ground_is_to_be_seen_nothing_is_watched() -> None:
    nothing = picture(**NOTHING)
    tracker = Tracker(SPEC)
    known = tracker.look(nothing)
    none = Edges(tracker, Ground(tracker, nothing, known), nothing, nothing, known)
    assert in_danger(none, nothing) == [False, False]


def test_the_cost_of_followed_objects_counts_it_as_lost_and_does_not_forget_it() -> None:
    left = AT[0] - 2
    start, goal = on_a_table(picture(), left), on_a_table(picture(red=(44, 30)), left)
    tracked = Tracker(SPEC).meet(start, goal)
    cost = make_cost("followed", PerfectGridModel(), SPEC, start, goal, tracked, Sights.first(start))
    assert isinstance(cost, FollowedCost)
    found, known = cost.of_frames(smeared(left), FIRST, FIRST, cost.begin())
    assert found.item() == pytest.approx(24**2 + LOST, abs=LOST / 8)
    later, _ = cost.of_frames(goal, FIRST, FIRST, known)
    assert later.item() == pytest.approx(LOST, abs=LOST / 8)
    unseen, _ = cost.of_frames(goal, FIRST, FIRST, cost.of_frames(start, FIRST, FIRST, cost.begin())[1])
    assert unseen.item() == pytest.approx(0, abs=LOST / 8)
