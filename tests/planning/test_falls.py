"""What stands at the table's edge is watched: a first step that carries it out or leaves nothing of it may lose it."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, SETTINGS, SPEC, TABLE, on_a_table, picture

from dmotion_bench.planning.objectives.tabletop.falls import FallRisk
from dmotion_bench.planning.objectives.tabletop.followed import FollowedObjects
from dmotion_bench.planning.objectives.tabletop.objective import TabletopEvaluator
from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.table_area import TableArea
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker

PRICE = (SETTINGS.lost_distance * SPEC.width) ** 2
FALLS, STAYS = [round(SETTINGS.fall_likely, 4), 0], [0, 0]
"""Of the red box and of the blue one."""


def edges_in(frame: torch.Tensor, known: BoundingBoxes, goal: torch.Tensor | None = None) -> FallRisk:
    occlusion = OcclusionModel(SETTINGS, tracker := Tracker(SPEC, SETTINGS), frame, known)
    return FallRisk(
        SETTINGS,
        tracker,
        occlusion,
        TableArea(SETTINGS, occlusion, frame, frame if goal is None else goal),
        frame,
        known,
    )


def edges(left: int = 0, top: int = 0, **start: object) -> FallRisk:
    frame = on_a_table(picture(**start), left, top)
    return edges_in(frame, Tracker(SPEC, SETTINGS).look(frame))


def risk(of: FallRisk, frame: torch.Tensor) -> list[float]:
    asked = torch.ones((1, 2), dtype=torch.bool)
    return [
        round(chance, 4) for chance in of.risk(frame, Tracker(SPEC, SETTINGS).look(frame), FIRST, asked)[0].tolist()
    ]


NEAR = int(SETTINGS.edge_margin * SPEC.width)
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
    assert risk(edges(left, top), on_a_table(picture(**NOTHING), left, top)) == (FALLS if watched else STAYS)


def carried(out: int, share: float, left: int) -> torch.Tensor:
    """The red box ``out`` pixels nearer to the table's left edge, with this share of its rows, the rest bare."""
    frame = on_a_table(picture(red=(AT[0] - out, AT[1])), left)
    rows = round(11 * share)
    frame[:, AT[1] - 5 + rows : AT[1] + 6, AT[0] - 5 - out : AT[0] + 6 - out] = TABLE
    return frame


@pytest.mark.parametrize(
    ("out", "share", "chance"),
    [
        (0, SETTINGS.gone_share - 0.1, SETTINGS.fall_likely),
        (0, SETTINGS.gone_share + 0.1, SETTINGS.fall_unlikely),
        (0, SETTINGS.unsure_below - 0.1, SETTINGS.fall_unlikely),
        (0, SETTINGS.unsure_below + 0.1, 0),
        (3, SETTINGS.gone_share + 0.1, SETTINGS.fall_likely),
        (3, SETTINGS.fall_below - 0.1, SETTINGS.fall_likely),
        (3, SETTINGS.fall_below + 0.1, SETTINGS.fall_unlikely),
        (3, SETTINGS.may_fall_below - 0.1, SETTINGS.fall_unlikely),
        (3, 1.0, 0),
        (-3, SETTINGS.fall_below - 0.1, SETTINGS.fall_unlikely),
        (-3, SETTINGS.unsure_below + 0.1, 0),
        (-3, SETTINGS.gone_share - 0.1, SETTINGS.fall_likely),
    ],
)
def test_what_is_left_of_it_and_which_way_it_goes_decide(out: int, share: float, chance: float) -> None:
    left = AT[0] - 4
    assert risk(edges(left), carried(out, share, left)) == [round(chance, 4), 0]


@pytest.mark.parametrize(("columns", "watched"), [(9, False), (6, True)])
def test_what_the_agent_hides_already_is_not_watched(columns: int, watched: bool) -> None:
    """Of eleven columns of the box; the next step may well hide the rest."""
    assert (1 - columns / 11 >= SETTINGS.edge_open_share) == watched
    left, curtain = AT[0] - 2, slice(AT[0] - 5, AT[0] - 5 + columns)
    frame = on_a_table(picture(curtain=curtain), left)
    tracker = Tracker(SPEC, SETTINGS)
    known = tracker.update(tracker.look(on_a_table(picture(), left)), frame)
    of = edges_in(frame, known)
    assert risk(of, on_a_table(picture(red=None, curtain=curtain), left)) == (FALLS if watched else STAYS)


def test_what_passes_before_it_reaches_below_it_and_a_smear_does_not() -> None:
    left = AT[0] - 2
    passing = on_a_table(picture(curtain=slice(AT[0], AT[0] + 9)), left)
    assert risk(edges(left), smeared(left)) == FALLS
    assert risk(edges(left), passing) == STAYS
    assert risk(edges(left), smeared(left, slice(AT[1] - 5, AT[1] + 7))) == FALLS
    assert risk(edges(left), smeared(left, slice(AT[1] - 5, AT[1] + 10))) == STAYS


def test_what_stood_below_it_before_passes_nothing() -> None:
    """The curtain is there already; a box of which a third more is lost is in danger."""
    curtain = slice(AT[0] + 2, AT[0] + 9)
    frame = on_a_table(picture(red=None, curtain=curtain), AT[0] - 2)
    assert risk(edges(AT[0] - 2, curtain=curtain), frame) == FALLS
    same = on_a_table(picture(curtain=curtain), AT[0] - 2)
    assert risk(edges(AT[0] - 2, curtain=curtain), same) == STAYS


def test_the_goal_shows_ground_that_the_agent_hides_now() -> None:
    """A curtain over the left of the table is not its edge."""
    curtain = slice(0, AT[0] - 2)
    frame, goal = on_a_table(picture(curtain=curtain)), on_a_table(picture())
    tracker = Tracker(SPEC, SETTINGS)
    known = tracker.update(tracker.look(goal), frame)
    gone = on_a_table(picture(red=None, curtain=curtain))
    assert risk(edges_in(frame, known), gone) == FALLS
    assert risk(edges_in(frame, known, goal), gone) == STAYS


def test_only_what_is_asked_about_may_fall() -> None:
    gone = on_a_table(picture(red=None), AT[0] - 2)
    nobody = torch.zeros((1, 2), dtype=torch.bool)
    assert not edges(AT[0] - 2).risk(gone, Tracker(SPEC, SETTINGS).look(gone), FIRST, nobody).any()


def test_where_no_ground_is_to_be_seen_nothing_is_watched() -> None:
    nothing = picture(**NOTHING)
    tracker = Tracker(SPEC, SETTINGS)
    known = tracker.look(nothing)
    none = edges_in(nothing, known)
    assert risk(none, nothing) == STAYS


def test_the_cost_of_followed_objects_counts_what_is_to_be_feared_and_does_not_forget_it() -> None:
    left = AT[0] - 2
    start, goal = on_a_table(picture(), left), on_a_table(picture(red=(44, 30)), left)
    cost = TabletopEvaluator(SETTINGS, SPEC, start, goal).now(torch.device("cpu"))
    for first, chance in (
        (smeared(left), SETTINGS.fall_likely),
        (carried(3, SETTINGS.may_fall_below - 0.1, left), SETTINGS.fall_unlikely),
        (start, 0),
    ):
        _, known = cost.of_frames(first, FIRST, FIRST, cost.begin())
        later, _ = cost.of_frames(goal, FIRST, FIRST, known)
        assert later.total.item() == pytest.approx(chance * PRICE, abs=SPEC.width / 8)
    found, _ = cost.of_frames(smeared(left), FIRST, FIRST, cost.begin())
    assert found.total.item() == pytest.approx(24**2 + SETTINGS.fall_likely * PRICE, abs=SPEC.width / 8)


def test_what_may_fall_counts_though_the_goal_does_not_show_it() -> None:
    left = AT[0] - 2
    start, goal = on_a_table(picture(), left), on_a_table(picture(red=None), left)
    known, wanted = Tracker(SPEC, SETTINGS).look(start), Tracker(SPEC, SETTINGS).look(goal)
    cost = FollowedObjects(SETTINGS, SPEC, known, wanted, falls=edges(left))
    assert cost.of_frames(smeared(left), FIRST, FIRST, cost.begin())[0].total.item() == pytest.approx(
        SETTINGS.fall_likely * PRICE
    )
