"""What the objects stand on is a polygon around all that is seen of the ground, now or in the goal's picture."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import FIRST, SETTINGS, SPEC, on_a_table, picture

from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.table_area import TableArea
from dmotion_bench.planning.objectives.tracking import Tracker

LEFT, RIGHT, TOP, END = 8, 60, 12, 62
"""The table's first and last columns and rows, each last one excluded."""


def seen(curtain: slice | None = None) -> torch.Tensor:
    return on_a_table(picture(curtain=curtain), LEFT, TOP, RIGHT, END)


def table(frame: torch.Tensor, goal: torch.Tensor) -> TableArea:
    tracker = Tracker(SPEC, SETTINGS)
    return TableArea(SETTINGS, OcclusionModel(SETTINGS, tracker, frame, tracker.look(goal)), frame, goal)


@pytest.mark.parametrize("curtain", [None, slice(0, 12), slice(56, 64)])
def test_it_lies_where_the_ground_is_seen_now_or_at_the_goal(curtain: slice | None) -> None:
    inside = table(seen(curtain), seen()).inside[0]
    rows, columns = inside.nonzero(as_tuple=True)
    assert (columns.min() - LEFT, RIGHT - 1 - columns.max()) == pytest.approx((2, 2), abs=1)
    assert (rows.min() - TOP, END - 1 - rows.max()) == pytest.approx((2, 2), abs=1)
    assert inside[TOP + 4 : END - 4, LEFT + 4 : RIGHT - 4].all()  # what stands on it and before it is on it


def test_what_nobody_ever_sees_is_not_on_it() -> None:
    hidden = seen(slice(0, 24))
    assert not table(hidden, hidden).inside[0, :, :20].any()


def test_depth_is_the_distance_from_the_nearest_edge_and_negative_beside_it() -> None:
    of = table(seen(), seen())
    places = torch.tensor([[[LEFT + 10.0, 36.0], [RIGHT - 4.0, 36.0], [34.0, TOP + 6.0], [34.0, TOP - 5.0]]])
    assert of.depth(places, FIRST)[0].tolist() == pytest.approx([10, 3, 6, -5], abs=2)


def test_where_no_ground_is_seen_everything_is_far_from_its_edge() -> None:
    nothing = picture(red=None, blue=None)
    of = table(nothing, nothing)
    assert of.depth(torch.tensor([[[3.0, 3.0]]]), FIRST).item() > 1e30
    assert of.inside.all()
