"""The control tasks of the pushing environments: exact, worth solving, and enough of them."""

from __future__ import annotations

import numpy as np
import pytest

from dmotion_bench.environment import Environment
from dmotion_bench.planning.tasks import load_problems, measure_of, task_environment
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.registry import environment_class, environment_names
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.tasks import ENOUGH_INTERACTIONS, GOAL_DISTANCE

TASKS = 3


@pytest.fixture(scope="module", params=["planar_push", "push_t", "robot_push"])
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("tasks") / request.param
    record_dataset(folder, recipe_for(request.param, Preset.SMALL, episodes=24, tasks=TASKS))
    return Dataset.open(folder)


@pytest.mark.slow
def test_the_recorded_actions_reach_the_goal_exactly(dataset: Dataset) -> None:
    env: Environment = task_environment(dataset.recipe)
    problems = load_problems(dataset)
    assert len(problems) == TASKS
    for problem in problems:
        task = problem.task
        frame, _ = env.reset(seed=problem.seed)
        for action in problem.opening.tolist():
            frame, *_ = env.step(action)
        np.testing.assert_array_equal(frame, problem.start_frame)
        np.testing.assert_array_equal(env.objects().position, problem.start_objects.position)
        measure = measure_of(env, problem)
        assert measure.distance(env) == 1
        for action in dataset.states(task.episode).actions[task.start : task.goal].tolist():
            frame, *_ = env.step(action)
        np.testing.assert_array_equal(frame, problem.goal_frame)
        np.testing.assert_array_equal(env.objects().position, problem.goal_objects.position)
        assert measure.distance(env) == 0
    env.close()


@pytest.mark.slow
def test_many_interactions_lie_between_start_and_goal(dataset: Dataset) -> None:
    for task in dataset.tasks():
        labels = dataset.states(task.episode)
        moved = np.linalg.norm(np.diff(labels.objects.position, axis=0), axis=-1) > dataset.spec.push_threshold
        assert moved[task.start : task.goal].any(axis=-1).sum() >= ENOUGH_INTERACTIONS
        assert task.goal - task.start == GOAL_DISTANCE
        assert not np.isnan(labels.objects.position[task.goal]).any()


@pytest.mark.parametrize("environment", environment_names())
@pytest.mark.parametrize("preset", [Preset.SMALL, Preset.PAPER])
def test_every_preset_that_is_no_test_has_a_hundred_tasks(environment: str, preset: Preset) -> None:
    assert environment_class(environment).recording[preset].tasks >= 100
