"""Where things that vanish do not come back, as video shows it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from planning.boxes import SPEC, picture

from dmotion_bench.planning.objectives.tracked_belief import TrackedBelief
from dmotion_bench.planning.objectives.tracking import Tracker
from dmotion_bench.planning.objectives.vanishing import AT_MOST, WIDTHS_PX, Vanishings

BELOW = 0.15
LEDGE, BEHIND = 12, 44  # columns: what vanishes at the first stays away, what vanishes at the second comes back


def episode(column: int, row: int, *, comes_back: bool) -> torch.Tensor:
    """The red box is there, then it is not; then it is again, or is not."""
    there, away = picture(red=(column, row), blue=None), picture(red=None, blue=None)
    return torch.cat([there, there, away, away, there if comes_back else away])


def watched(episodes: Sequence[torch.Tensor]) -> Vanishings:
    return Vanishings.seen_in(episodes, Tracker(SPEC, TrackedBelief()), BELOW)


def both_places(count: int = 8) -> Vanishings:
    """So many episodes at either place, in rows around the middle."""
    rows = range(30 - count // 2, 30 + count - count // 2)
    return watched(
        [episode(LEDGE, row, comes_back=False) for row in rows]
        + [episode(BEHIND, row, comes_back=True) for row in rows]
    )


def at(*columns: float) -> torch.Tensor:
    return torch.tensor([[[column, 30.0] for column in columns]])


def test_video_shows_where_things_vanish_for_good() -> None:
    known = both_places()
    assert len(known.gone) == 16
    assert known.gone.tolist() == [True] * 8 + [False] * 8
    lost, hidden = known.chance(at(LEDGE, BEHIND))[0]
    assert lost > 0.85 > 0.15 > hidden
    assert known.chance(at(LEDGE + 1)) > 0.85
    assert known.chance(at(1000)).item() == pytest.approx(0.5)  # nothing is known there: the mean over all places


def test_nothing_is_feared_where_nothing_ever_vanished() -> None:
    for video in ([], [torch.cat([picture(), picture()])]):
        assert not watched(video).chance(at(LEDGE, BEHIND)).any()


def test_what_is_only_partly_covered_has_not_vanished() -> None:
    half = picture(red=(18, 30), blue=None, curtain=slice(14, 20))
    assert not len(watched([torch.cat([picture(red=(18, 30), blue=None), half])]).gone)


def test_the_kernel_is_as_wide_as_the_places_where_things_vanish() -> None:
    rows = range(12, 52, 2)
    close = watched([episode(column, row, comes_back=column == 31) for row in rows for column in (28, 31)])
    wide = watched([episode(column, row, comes_back=column > 32) for row in rows for column in (8, 20, 44, 56)])
    assert WIDTHS_PX[0] <= close.width < 3 < wide.width  # the places are 3 px apart, or 12


@pytest.mark.slow
def test_of_very_many_some_are_kept() -> None:
    many = torch.cat([picture(), picture(red=None, blue=None)] * 5)
    known = watched([many] * (AT_MOST // 8))
    assert len(known.gone) == AT_MOST
