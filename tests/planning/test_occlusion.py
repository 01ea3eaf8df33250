"""What something stands before is not lost, and what leaves bare ground is."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, SETTINGS, SPEC, on_a_table, picture

from dmotion_bench.planning.objectives.tabletop.followed import FollowedObjects
from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tracking import Tracker

GOAL = (44, 30)
MAY_BE_LOST = SETTINGS.fall_unlikely * (SETTINGS.lost_distance * SPEC.width) ** 2
RED_ONE = torch.tensor([[True, False]])


def occlusion() -> OcclusionModel:
    tracker = Tracker(SPEC, SETTINGS)
    return OcclusionModel(SETTINGS, tracker, picture(), tracker.look(picture()))


@pytest.mark.parametrize(
    ("curtain", "covered"),
    [
        (None, False),
        (slice(0, 14), False),
        (slice(14, 27), True),
        (slice(17, 25), True),
        (slice(19, 24), False),
        (slice(14, 16), False),
    ],
)
def test_what_is_seen_where_an_object_was_decides(curtain: slice | None, covered: bool) -> None:
    gone = picture(red=None, curtain=curtain)
    assert occlusion().hides(gone, FIRST, RED_ONE).tolist() == [[covered, False]]


def test_only_what_is_asked_about_is_covered() -> None:
    everything = picture(curtain=slice(0, 64))
    assert occlusion().hides(everything, FIRST, ~RED_ONE).tolist() == [[False, True]]
    assert not occlusion().hides(everything, FIRST, RED_ONE & ~RED_ONE).any()


def test_an_object_at_the_edge_of_the_picture_and_one_that_was_never_seen() -> None:
    start = picture(red=(5, 5), blue=None)
    tracker = Tracker(SPEC, SETTINGS)
    occlusion = OcclusionModel(SETTINGS, tracker, start, tracker.look(start))
    both = torch.tensor([[True, True]])
    assert occlusion.hides(picture(curtain=slice(0, 64)), FIRST, both).tolist() == [[True, False]]
    assert occlusion.hides(picture(red=None), FIRST, both).tolist() == [[False, False]]


def test_the_cost_tells_them_apart() -> None:
    known, wanted = Tracker(SPEC, SETTINGS).meet(picture(), picture(red=GOAL))
    for frame, price in ((picture(red=None), 24**2 + MAY_BE_LOST), (picture(red=None, curtain=slice(14, 27)), 24**2)):
        for grounded in (True, False):
            cost = FollowedObjects(SETTINGS, SPEC, known, wanted, occlusion=occlusion() if grounded else None)
            found, known_then = cost.of_frames(frame, FIRST, FIRST, cost.begin())
            assert found.total.item() == pytest.approx(price if grounded else 24**2 + MAY_BE_LOST)
            back, _ = cost.of_frames(picture(red=AT), FIRST, FIRST, known_then)
            assert back.total.item() == found.total.item()  # what the first step says stays said


def test_what_is_partly_hidden_already_is_covered_when_it_is_gone() -> None:
    tracker = Tracker(SPEC, SETTINGS)
    known = tracker.update(tracker.look(picture()), hidden := picture(curtain=slice(10, 18)))
    assert OcclusionModel(SETTINGS, tracker, hidden, known).hides(picture(red=None), FIRST, RED_ONE).tolist() == [
        [True, False]
    ]


@pytest.mark.parametrize(("curtain", "standing"), [(slice(14, 27), True), (slice(17, 25), True), (None, False)])
def test_an_object_that_something_stands_before_has_not_fallen(curtain: slice | None, standing: bool) -> None:
    tracker = Tracker(SPEC, SETTINGS)
    known = tracker.update(tracker.look(picture()), gone := picture(red=None, curtain=curtain))
    assert OcclusionModel(SETTINGS, tracker, gone, known).standing.tolist() == [[standing, True]]


def test_an_object_that_was_never_seen_stands_nowhere() -> None:
    tracker = Tracker(SPEC, SETTINGS)
    alone = picture(red=None, curtain=slice(10, 30))
    assert OcclusionModel(SETTINGS, tracker, alone, tracker.look(alone)).standing.tolist() == [[False, True]]


def test_an_object_at_the_edge_of_the_table_has_two_grounds() -> None:
    left = AT[0] - 1  # the table's edge runs below the object
    start = on_a_table(picture(), left)
    tracker = Tracker(SPEC, SETTINGS)
    occlusion = OcclusionModel(SETTINGS, tracker, start, tracker.look(start))
    assert occlusion.hides(on_a_table(picture(red=None), left), FIRST, RED_ONE).tolist() == [[False, False]]
    behind = on_a_table(picture(red=None, curtain=slice(17, 25)), left)
    assert occlusion.hides(behind, FIRST, RED_ONE).tolist() == [[True, False]]
