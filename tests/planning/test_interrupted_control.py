"""Control that is killed goes on with the same result, and takes up nothing else's progress."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planning.worlds import tracking

from dmotion_bench.actions import Discrete
from dmotion_bench.planning.journal import Extent, Journal
from dmotion_bench.planning.mpc import ControlResult, ControlSettings, Scene, control
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.planning.tasks import Problem
from dmotion_bench.scoring.control import ControlScoring, score_control
from dmotion_bench.storage.dataset import Dataset
from recorders.grid_world import GridWorld

pytestmark = pytest.mark.slow

EXTENT = Extent(actions=Discrete.numbered(4), tasks=6, steps=6)


class Killed(Exception):
    """The process is gone."""


FEW = CrossEntropy(samples=8, horizon=4, iterations=1, elites=3, kept_elites=3)
SELDOM = replace(FEW, replan_every=3)
PAIRS = ControlSettings(steps=6, group=2)


@pytest.mark.parametrize(
    ("solver", "dies_at"), [(FEW, 1), (FEW, 5), (FEW, 8), (FEW, 11), (SELDOM, 1), (SELDOM, 3), (SELDOM, 8)]
)
def test_a_killed_run_goes_on_with_the_same_result(
    solver: CrossEntropy, problems: list[Problem], tmp_path: Path, dies_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    whole = control(tracking(solver), problems[:4], GridWorld, PAIRS)

    def run(watch: Callable[[Scene], None] = lambda _: None) -> ControlResult:
        journal = Journal(tmp_path / "journal.json", {"who": "me"}, EXTENT)
        return control(tracking(solver), problems[:4], GridWorld, PAIRS, journal=journal, watch=watch)

    steps: Iterator[int] = iter(range(100))

    def die(_: Scene) -> None:
        if next(steps) == dies_at:
            raise Killed

    with pytest.raises(Killed):
        run(die)
    begun = run()
    for field in ("actions", "distance", "lost"):
        np.testing.assert_array_equal(getattr(begun, field), getattr(whole, field))
    assert begun.frames == whole.frames
    assert begun.planned == 24 - 2 * dies_at
    assert run().planned == 0


def _killed_at(place: Path, problems: list[Problem], step: int, settings: ControlSettings = PAIRS) -> None:
    """Leave a journal of tasks that were killed before the action at a step, counted over all groups."""
    steps = itertools.count()

    def die(_: Scene) -> None:
        if next(steps) == step:
            raise Killed

    with pytest.raises(Killed):
        control(tracking(FEW), problems, GridWorld, settings, journal=Journal(place, {}, EXTENT), watch=die)


def test_shares_that_were_killed_go_on_with_the_same_result(
    problems: list[Problem], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    whole = control(tracking(FEW), problems[:4], GridWorld, PAIRS)
    for first, dies_at in ((0, 2), (2, 4)):
        _killed_at(tmp_path / f"share-{first}.json", problems[first : first + 2], dies_at)
    journal = Journal(tmp_path / "journal.json", {}, EXTENT)
    for first in (0, 2):
        journal.take_over(tmp_path / f"share-{first}.json")

    begun = control(tracking(FEW), problems[:4], GridWorld, PAIRS, journal=journal)

    assert begun.planned == 24 - 2 * (2 + 4)
    np.testing.assert_array_equal(begun.actions, whole.actions)
    np.testing.assert_array_equal(begun.distance, whole.distance)


def test_a_group_that_begins_anew_remembers_nothing(
    problems: list[Problem], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    for first, dies_at in ((0, 2), (2, 4)):
        _killed_at(tmp_path / f"share-{first}.json", problems[first : first + 2], dies_at)
    journal, remembered = Journal(tmp_path / "journal.json", {}, EXTENT), list[Any]()
    for first in (0, 2):
        journal.take_over(tmp_path / f"share-{first}.json")

    control(
        tracking(FEW),
        problems[:4],
        GridWorld,
        replace(PAIRS, group=4),
        journal=journal,
        watch=lambda scene: remembered.append(scene.context.memory),
    )

    assert len(remembered) == PAIRS.steps  # the tasks had not reached the same step
    assert remembered[0] is None


def test_progress_of_something_else_is_not_taken_up(dataset: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "control.json"
    scoring = ControlScoring(tasks=2, steps=4, group=2)
    first = score_control("random", dataset, scoring, checkpoint=file)
    assert score_control("random", dataset, scoring, checkpoint=file).planned == 0
    more = score_control("random", dataset, replace(scoring, tasks=6), checkpoint=file)
    assert more.planned == 16  # the first two tasks are done
    np.testing.assert_array_equal(more.actions[:2], first.actions)
    assert score_control("random", dataset, replace(scoring, seed=1), checkpoint=file).planned == 8
    for spoilt in ("", "[]", '{"format": "dmbench-control/2"}', file.read_text().replace("distance", "distant")):
        file.write_text(spoilt)
        again = score_control("random", dataset, scoring, checkpoint=file)
        assert again.planned == 8
        np.testing.assert_array_equal(again.actions, first.actions)
