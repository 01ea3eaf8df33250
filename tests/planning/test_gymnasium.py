"""Control in a world that tells nothing but pictures: its tasks, who judges them, and what is left out by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import strange_worlds
from known_model import result_of
from strange_worlds import SLIDER

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.planning.choices import default_objective, make_objective
from dmotion_bench.planning.tasks import (
    Judge,
    PictureDistance,
    World,
    as_actions,
    judge_of,
    load_problems,
    task_environment,
)
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring, control_samples
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.reference_control import score_reference
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.tiers import tier_of_data
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.repair import rebuild_tables
from dmotion_bench.storage.tasks import GOAL_DISTANCE, START_SPACING, picture_candidates
from dmotion_bench.workspace import Workspace

strange_worlds.register()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    path = tmp_path_factory.mktemp("data") / "slider"
    settings = ("places=30",)
    record_dataset(
        path, recipe_for(SLIDER, Preset.TINY, episodes=14, frames=12, tasks=5, size=64, settings=settings, seed=3)
    )
    return Dataset.open(path)


@pytest.mark.slow
def test_a_task_is_reached_by_replay_and_its_own_actions_solve_it(dataset: Dataset) -> None:
    problems = load_problems(dataset)
    assert len(problems) == 5
    for problem in problems:
        env = task_environment(dataset.recipe)
        assert judge_of(env) is Judge.PICTURES
        world = World(env, problem)
        assert world.distance == 1.0
        actions = dataset.states(problem.task.episode).actions
        for action in as_actions(actions[problem.task.start : problem.task.goal]):
            world.step(action)
        np.testing.assert_array_equal(world.frame, problem.goal_frame)
        assert world.distance == 0.0
        assert world.lost == 0


def test_the_distance_is_that_of_the_pictures(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    start, goal, now = (np.full((4, 4, 3), value, np.uint8) for value in (10, 50, 30))
    env = task_environment(dataset.recipe)
    monkeypatch.setattr(env, "render", lambda: now)
    measure = PictureDistance(start, goal)
    assert measure.cost(env) == 400.0
    assert measure.distance(env) == 0.25


def test_candidates_change_and_keep_apart() -> None:
    still = np.zeros((40, 4, 4, 3), np.uint8)
    assert picture_candidates(still) == ()
    assert picture_candidates(still[:1]) == ()
    moving = still.copy()
    moving[np.arange(40), np.arange(40) % 4, 0] = 200  # a dot that goes round in four steps
    found = picture_candidates(moving)
    assert found
    starts = sorted(one.start for one in found)
    assert min(np.diff(starts)) >= START_SPACING
    for one in found:
        assert one.goal == min(one.start + GOAL_DISTANCE, 39)
        assert (moving[one.start] != moving[one.goal]).any()
        assert one.interactions == one.goal - one.start


def test_tables_made_again_have_the_same_tasks(dataset: Dataset) -> None:
    before = [(dataset.path / name).read_bytes() for name in ("tasks.parquet", "dataset.json")]
    rebuild_tables(dataset.path, dataset.manifest)
    assert [(dataset.path / name).read_bytes() for name in ("tasks.parquet", "dataset.json")] == before


def test_figures_of_control_say_that_pictures_judge(dataset: Dataset) -> None:
    scoring = ControlScoring(tasks=2, steps=3, group=2)
    result = score_reference("random", dataset, scoring)
    figures = figures_of(control_samples("random", result), "random", resamples=50)
    assert set(figures) == {f"control_picture_distance[{step}]" for step in (1, 2, 3)}
    assert figures["control_picture_distance[3]"].mean == pytest.approx(result.distance[:, 3].mean(), rel=1e-6)
    idle = score_reference("idle", dataset, scoring)
    assert (idle.distance == 1).all()


def test_the_oracle_plans_by_replay(dataset: Dataset) -> None:
    settings = ("samples=6", "horizon=2", "iterations=1", "elites=2")
    scoring = ControlScoring(tasks=2, steps=2, group=1, planner_set=settings)
    oracle = score_reference("oracle", dataset, scoring)
    assert (oracle.distance[:, -1] <= 1).all()
    assert oracle.judge is Judge.PICTURES


@pytest.mark.slow
def test_a_report_names_what_is_left_out(dataset: Dataset, tmp_path: Path) -> None:
    run = open_run(TrainingRequest(model="dmotion"), dataset, None, Workspace(tmp_path))
    weights = run.spec.build().state_dict()
    checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
    run.finish(result_of(weights))
    settings = ScoreSettings(
        horizon=2,
        resamples=50,
        control=ControlScoring(
            tasks=1, steps=2, group=1, planner_set=("samples=3", "horizon=1", "iterations=1", "elites=1")
        ),
    )
    report = score_run(run.path, metrics=("prediction", "control"), settings=settings)
    assert {"mse", "motion_swap_change", "control_picture_distance[2]"} <= set(report.figures)
    left_out = report.remarks["positions"]
    for name in ("position_error", "control_distance", "control_success", "agent_iou", "motion_shift_error"):
        assert name in left_out
        assert not [one for one in report.figures if one.startswith(name)]
    assert "no distance of objects" in report.remarks["control"]
    assert report.planning["objective"]["name"] == "pixel"
    again = score_run(run.path, metrics=("prediction",), settings=settings, renew=False)
    assert "control_picture_distance[2]" in again.figures


def test_objectives_that_look_for_objects_are_refused_by_name(dataset: Dataset) -> None:
    assert default_objective(SLIDER, dataset.spec, needs_pixels=True) == "pixel"
    assert default_objective(SLIDER, dataset.spec, needs_pixels=False) == "feature"
    assert tier_of_data(dataset.spec, dataset.recipe).value == "pixels"
    picture = dataset.video(0)[:1]
    with pytest.raises(InvalidSetting, match="has no coloured objects to find"):
        make_objective("centres").reset(dataset.spec, picture, picture)
