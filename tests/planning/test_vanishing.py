"""Where things that vanish do not come back, as video shows it, and how a planner fears it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from planning.boxes import FIRST, SPEC, picture
from planning.test_tracked_risk import GOAL, LEFT, LOST, Shown, faded

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.choices import make_objective
from dmotion_bench.planning.objectives.base import taught
from dmotion_bench.planning.objectives.centres import Centres
from dmotion_bench.planning.objectives.tracked_vanishing import TaughtVanishing, TrackedVanishing
from dmotion_bench.planning.objectives.tracking import Tracker
from dmotion_bench.planning.objectives.vanishing import AT_MOST, WIDTHS_PX, Vanishings
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset

BELOW = 0.15
LEDGE, BEHIND = 12, 44  # columns: what vanishes at the first stays away, what vanishes at the second comes back


def episode(column: int, row: int, *, comes_back: bool) -> torch.Tensor:
    """The red box is there, then it is not; then it is again, or is not."""
    there, away = picture(red=(column, row), blue=None), picture(red=None, blue=None)
    return torch.cat([there, there, away, away, there if comes_back else away])


def watched(episodes: Sequence[torch.Tensor]) -> Vanishings:
    return Vanishings.seen_in(episodes, Tracker(SPEC, TrackedVanishing()), BELOW)


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


def test_of_very_many_some_are_kept() -> None:
    many = torch.cat([picture(), picture(red=None, blue=None)] * 5)
    known = watched([many] * (AT_MOST // 8))
    assert len(known.gone) == AT_MOST


def imagined_risk(judge: TaughtVanishing, seen: Sequence[torch.Tensor], frame: torch.Tensor) -> float:
    """Of a first imagined frame, after these images."""
    found = judge.reset(SPEC, picture().numpy(), picture(red=GOAL).numpy())
    for image in seen:
        found.observe(FIRST.numpy(), image.numpy())
    dynamics = Shown()
    cost, _ = found.step(dynamics, (frame,), FIRST, FIRST, found.begin(dynamics))
    assert cost.total.item() == pytest.approx(cost.distance.item() + cost.risk.item())
    return cost.risk.item()


def test_fading_is_feared_where_things_vanish_for_good_and_not_where_they_come_back() -> None:
    place = 20.0, 30.0  # of the red box, in ``picture``
    fading = (0.6 - 2 / 11) / 0.45
    for gone in (True, False):
        known = Vanishings(place=torch.tensor([place] * 50), gone=torch.tensor([gone] * 50), width=2.0)
        judge = TaughtVanishing(settings=TrackedVanishing(), vanishings=known)
        in_part = picture(curtain=slice(14, 22))
        for seen in ([], [in_part, picture()]):  # that something hides objects changes nothing
            risk = imagined_risk(judge, seen, faded(2))
            assert risk == pytest.approx((LOST - LEFT) * fading * gone, rel=0.01)
        assert imagined_risk(judge, [], picture()) == 0


def test_it_learns_from_video_before_it_is_used_and_reads_no_label(tmp_path: Path) -> None:
    objective = make_objective("tracked-vanishing", ["lost_below=0.2"])
    assert objective == TrackedVanishing(lost_below=0.2)
    frame = picture().numpy()
    with pytest.raises(InvalidSetting, match="learns from video first"):
        objective.reset(SPEC, frame, frame)
    plain = Centres()
    record_dataset(tmp_path / "tiny", recipe_for("planar_push", Preset.TINY))
    dataset = Dataset.open(tmp_path / "tiny")
    assert taught(plain, dataset) is plain
    known = taught(objective, dataset)
    assert isinstance(known, TaughtVanishing)
    assert known.settings == objective
    twice = taught(objective, dataset)
    assert isinstance(twice, TaughtVanishing)
    assert twice.vanishings is known.vanishings
    shutil.rmtree(dataset.path / "labels")
    again = TrackedVanishing(lost_below=0.2, safe_from=0.7).learned(dataset)
    assert torch.equal(again.vanishings.place, known.vanishings.place)
