"""What is to be pushed is approached from where it can be pushed, and the agent is found where it stands."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, SETTINGS, SPEC, picture

from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.push_pose import PushPoseBonus
from dmotion_bench.planning.objectives.tabletop.table_area import TableArea
from dmotion_bench.planning.objectives.tracking import Tracker

RIGHT_OF = (44, 30)
SOUGHT = torch.tensor([[True, True]])
BACK = 5.5 + SETTINGS.clearance * SPEC.width
"""From a box's centre to where it is pushed from [px]."""


def agent_at(x: int, y: int, **boxes: tuple[int, int] | None) -> torch.Tensor:
    """A white arm, five pixels wide, that comes from the top of the picture and ends here."""
    frame = picture(**boxes)
    frame[:, : y + 1, max(x - 2, 0) : x + 3] = 250
    return frame


def push_poses(
    red: tuple[int, int] = RIGHT_OF, blue: tuple[int, int] = (50, 50), sought: torch.Tensor = SOUGHT
) -> PushPoseBonus:
    start, goal, tracker = picture(), picture(red=red, blue=blue), Tracker(SPEC, SETTINGS)
    known, wanted = tracker.meet(start, goal)
    occlusion = OcclusionModel(SETTINGS, tracker, start, known)
    return PushPoseBonus(
        SETTINGS, tracker, occlusion, TableArea(SETTINGS, occlusion, start, goal), known, wanted, sought
    )


def nearness(of: PushPoseBonus, *tips: tuple[int, int]) -> list[float]:
    frames = torch.cat([agent_at(*tip, red=None) for tip in tips])
    return [one.item() for one in of.nearness(frames, FIRST.repeat(len(tips)))]


@pytest.mark.parametrize("tip", [(5, 40), (36, 10), (60, 59), (31, 61)])
def test_the_agent_stands_where_it_reaches_lowest(tip: tuple[int, int]) -> None:
    assert push_poses().tool_tip(agent_at(*tip), FIRST)[0].tolist() == pytest.approx(tip, abs=1)


def test_objects_blurred_edges_and_what_is_beside_the_table_are_no_agent() -> None:
    frame = picture()
    frame[:, AT[1] + 6, :] = 120  # one row
    assert push_poses().tool_tip(frame, FIRST).isnan()[0].tolist()[1]
    assert push_poses().nearness(frame, FIRST).tolist() == [0]
    beside = Tracker(SPEC, SETTINGS)
    table = picture()
    table[(table == 0).all(-1)] = torch.tensor([200, 180, 150], dtype=torch.uint8)
    table[:, 40:] = 0
    known = beside.look(table)
    occlusion = OcclusionModel(SETTINGS, beside, table, known)
    on_it = PushPoseBonus(
        SETTINGS, beside, occlusion, TableArea(SETTINGS, occlusion, table, table), known, known, SOUGHT
    )
    assert on_it.tool_tip(table, FIRST).isnan()[0, 1]


def test_the_way_leads_around_to_the_other_side_of_where_the_object_has_to_go() -> None:
    left, above, below = (AT[0] - round(BACK), AT[1]), (AT[0], AT[1] - 10), (AT[0], AT[1] + 10)
    right = (AT[0] + 12, AT[1])
    ways = nearness(push_poses(), left, above, right)
    assert ways == sorted(ways, reverse=True)
    assert ways[0] == pytest.approx(1, abs=2 / SPEC.width)
    assert nearness(push_poses(), below)[0] == pytest.approx(ways[1], abs=3 / SPEC.width)
    down = nearness(push_poses(red=(AT[0], 55)), above, left, below)
    assert down == sorted(down, reverse=True)


def test_the_object_with_the_longest_way_comes_first_and_what_is_not_sought_never() -> None:
    behind_blue = (50, 50 - round(BACK))
    both = push_poses(blue=(50, 56))
    assert nearness(both, behind_blue)[0] < nearness(push_poses(red=AT, blue=(50, 56)), behind_blue)[0]
    assert nearness(push_poses(sought=~SOUGHT), (AT[0] - 8, AT[1]), behind_blue) == [0, 0]
    only_blue = push_poses(blue=(50, 56), sought=torch.tensor([[False, True]]))
    assert nearness(only_blue, behind_blue)[0] == pytest.approx(1, abs=2 / SPEC.width)


def test_two_axes_lead_there_where_both_are_long() -> None:
    left, above = (AT[0] - round(BACK), AT[1]), (AT[0], AT[1] - round(BACK))
    skew = nearness(push_poses(red=(AT[0] + 20, AT[1] + 18)), left, above)
    assert min(skew) > 0.9
    flat = nearness(push_poses(red=(AT[0] + 20, AT[1] + 6)), left, above)
    assert flat[0] > 0.9 > flat[1]
