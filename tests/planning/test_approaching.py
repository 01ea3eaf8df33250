"""What is to be pushed is approached from where it can be pushed, and the agent is found where it stands."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, SPEC, picture

from dmotion_bench.planning.approaching import BERTH, Approach
from dmotion_bench.planning.covering import Ground
from dmotion_bench.planning.table import Table
from dmotion_bench.planning.tracking import Tracker

RIGHT_OF = (44, 30)
SOUGHT = torch.tensor([[True, True]])
BACK = 5.5 + BERTH * SPEC.width
"""From a box's centre to where it is pushed from [px]."""


def agent_at(x: int, y: int, **boxes: tuple[int, int] | None) -> torch.Tensor:
    """A white arm, five pixels wide, that comes from the top of the picture and ends here."""
    frame = picture(**boxes)
    frame[:, : y + 1, max(x - 2, 0) : x + 3] = 250
    return frame


def approach(
    red: tuple[int, int] = RIGHT_OF, blue: tuple[int, int] = (50, 50), sought: torch.Tensor = SOUGHT
) -> Approach:
    start, goal, tracker = picture(), picture(red=red, blue=blue), Tracker(SPEC)
    known, wanted = tracker.meet(start, goal)
    ground = Ground(tracker, start, known)
    return Approach(tracker, ground, Table(ground, start, goal), known, wanted, sought)


def nearness(of: Approach, *feet: tuple[int, int]) -> list[float]:
    frames = torch.cat([agent_at(*foot, red=None) for foot in feet])
    return [one.item() for one in of.nearness(frames, FIRST.repeat(len(feet)))]


@pytest.mark.parametrize("foot", [(5, 40), (36, 10), (60, 59), (31, 61)])
def test_the_agent_stands_where_it_reaches_lowest(foot: tuple[int, int]) -> None:
    assert approach().foot(agent_at(*foot), FIRST)[0].tolist() == pytest.approx(foot, abs=1)


def test_objects_blurred_edges_and_what_is_beside_the_table_are_no_agent() -> None:
    frame = picture()
    frame[:, AT[1] + 6, :] = 120  # one row
    assert approach().foot(frame, FIRST).isnan()[0].tolist()[1]
    assert approach().nearness(frame, FIRST).tolist() == [0]
    beside = Tracker(SPEC)
    table = picture()
    table[(table == 0).all(-1)] = torch.tensor([200, 180, 150], dtype=torch.uint8)
    table[:, 40:] = 0
    known = beside.look(table)
    ground = Ground(beside, table, known)
    on_it = Approach(beside, ground, Table(ground, table, table), known, known, SOUGHT)
    assert on_it.foot(table, FIRST).isnan()[0, 1]


def test_the_way_leads_around_to_the_other_side_of_where_the_object_has_to_go() -> None:
    left, above, below = (AT[0] - round(BACK), AT[1]), (AT[0], AT[1] - 10), (AT[0], AT[1] + 10)
    right = (AT[0] + 12, AT[1])
    ways = nearness(approach(), left, above, right)
    assert ways == sorted(ways, reverse=True)
    assert ways[0] == pytest.approx(1, abs=2 / SPEC.width)
    assert nearness(approach(), below)[0] == pytest.approx(ways[1], abs=3 / SPEC.width)
    down = nearness(approach(red=(AT[0], 55)), above, left, below)
    assert down == sorted(down, reverse=True)


def test_the_object_with_the_longest_way_comes_first_and_what_is_not_sought_never() -> None:
    behind_blue = (50, 50 - round(BACK))
    both = approach(blue=(50, 56))
    assert nearness(both, behind_blue)[0] < nearness(approach(red=AT, blue=(50, 56)), behind_blue)[0]
    assert nearness(approach(sought=~SOUGHT), (AT[0] - 8, AT[1]), behind_blue) == [0, 0]
    only_blue = approach(blue=(50, 56), sought=torch.tensor([[False, True]]))
    assert nearness(only_blue, behind_blue)[0] == pytest.approx(1, abs=2 / SPEC.width)


def test_two_axes_lead_there_where_both_are_long() -> None:
    left, above = (AT[0] - round(BACK), AT[1]), (AT[0], AT[1] - round(BACK))
    skew = nearness(approach(red=(AT[0] + 20, AT[1] + 18)), left, above)
    assert min(skew) > 0.9
    flat = nearness(approach(red=(AT[0] + 20, AT[1] + 6)), left, above)
    assert flat[0] > 0.9 > flat[1]
