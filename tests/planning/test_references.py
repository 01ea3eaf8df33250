"""The scripted pusher and the oracle on the pushing worlds, and the states that the oracle is put back into."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.environment import Environment, Restorable, Undrawn
from dmotion_bench.errors import InvalidSetting, RecordingFailed
from dmotion_bench.planning.agents import NO_ACTION, make_reference
from dmotion_bench.planning.dynamics.simulator import Simulation
from dmotion_bench.planning.mpc import ControlSettings, control
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.planning.tasks import Problem, World, load_problems
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.tasks import ControlTask
from recorders.grid_world import GridWorld
from recorders.planar_push import PlanarPush


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder: Path = tmp_path_factory.mktemp("data") / "planar"
    recipe = DatasetRecipe(environment="planar_push", policy="push", episodes=10, frames=40, tasks=2)
    record_dataset(folder, recipe)
    return Dataset.open(folder)


@pytest.fixture(scope="module")
def problems(dataset: Dataset) -> list[Problem]:
    return load_problems(dataset)


def away_from(env: Environment, frame: np.ndarray, task: ControlTask, seed: int) -> Problem:
    """What an environment shows after its reset, with goals a unit away along both axes."""
    objects = env.objects()
    return Problem(
        number=0,
        task=task,
        seed=seed,
        vary=(),
        opening=np.zeros(0, np.int64),
        start_frame=frame,
        goal_frame=frame,
        start_objects=objects,
        goal_objects=replace(objects, position=objects.position + 1),
    )


@pytest.mark.slow
def test_rules_bring_the_objects_nearer_and_then_stand_still(dataset: Dataset, problems: list[Problem]) -> None:
    pusher = make_reference("scripted", dataset.spec, PlanarPush, CrossEntropy())
    result = control(pusher, problems, PlanarPush, ControlSettings(steps=40))
    assert result.distance[:, -1].mean() < 0.75
    assert result.lost.sum() == 0
    stopped = result.actions[:, -1] == NO_ACTION
    np.testing.assert_array_equal(result.distance[stopped, -1], result.distance[stopped, -2])


class Scriptless(GridWorld):
    """Grid World without the rules of the reference ``scripted``."""

    script = None  # type: ignore[assignment]


def test_an_environment_without_a_script_says_so(problems: list[Problem]) -> None:
    env = Scriptless()
    frame, _ = env.reset(seed=0)
    problem = away_from(env, frame, problems[0].task, seed=0)
    with pytest.raises(InvalidSetting, match="'grid_world' comes with no scripted reference"):
        control(
            make_reference("scripted", env.facts, Scriptless, CrossEntropy()),
            [problem],
            Scriptless,
            ControlSettings(steps=1),
        )


@pytest.mark.slow
def test_the_oracle_follows_the_true_world(dataset: Dataset, problems: list[Problem]) -> None:
    planner = CrossEntropy(samples=12, horizon=5, iterations=2, elites=4)
    result = control(
        make_reference("oracle", dataset.spec, PlanarPush, planner), problems[:1], PlanarPush, ControlSettings(steps=12)
    )
    assert result.distance[0, -1] < 1
    assert result.lost.sum() == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_restored_state_goes_on_like_the_original(seed: int) -> None:
    generator = np.random.default_rng(seed)
    original, copy = PlanarPush(), PlanarPush()
    assert isinstance(original, Restorable)
    original.reset(seed=seed)
    copy.reset(seed=seed)
    off = []
    for _ in range(60):
        copy.step(int(generator.integers(4)))  # it has been elsewhere
        copy.restore(original.snapshot())
        np.testing.assert_allclose(copy.objects().position, original.objects().position, atol=1e-12)
        np.testing.assert_allclose(copy.agent().position, original.agent().position)
        action = int(generator.integers(4))
        frame, other = original.step(action)[0], copy.step(action)[0]
        off.append(np.nan_to_num(copy.objects().position - original.objects().position).__abs__().max())
        assert np.abs(frame.astype(int) - other).mean() < 0.1
    assert max(off) < 1e-3  # [m]
    assert np.median(off) < 1e-9


def test_a_restored_state_is_what_a_step_off_the_lattice_shows() -> None:
    env, elsewhere = PlanarPush(), PlanarPush()
    shown = env.reset(seed=0)[0]
    while env.legal_actions()[0]:
        shown = env.step(0)[0]
    elsewhere.reset(seed=0)
    elsewhere.restore(env.snapshot())
    frame, *_, info = elsewhere.step(0)
    assert info["illegal"]
    np.testing.assert_array_equal(frame, shown)


def test_advancing_without_drawing_does_to_the_state_what_a_step_does() -> None:
    stepped, advanced = PlanarPush(), PlanarPush()
    assert isinstance(advanced, Undrawn)
    stepped.reset(seed=2)
    advanced.reset(seed=2)
    for action in np.random.default_rng(0).integers(0, 4, 12).tolist():
        impossible = advanced.advance(action)
        frame, *_, info = stepped.step(action)
        assert impossible == info["illegal"]
        np.testing.assert_array_equal(advanced.objects().position, stepped.objects().position)
    action = int(np.flatnonzero(stepped.legal_actions())[0])
    frame, shown = stepped.step(action)[0], advanced.step(action)[0]
    np.testing.assert_array_equal(shown, frame)
    np.testing.assert_array_equal(advanced.masks(), stepped.masks())


class Replayed(GridWorld):
    """Grid World that cannot be restored, and counts how often it is started."""

    starts = 0
    snapshot = restore = None

    def reset(self, **options: Any) -> Any:
        self.starts += 1
        return super().reset(**options)


def test_what_cannot_be_restored_is_replayed_and_nothing_is_tried_twice(problems: list[Problem]) -> None:
    env = Replayed()
    frame, _ = env.reset(seed=4)
    problem = away_from(env, frame, problems[0].task, seed=4)
    world = World(GridWorld(), problem)
    simulation = Simulation(env, problem, pictures=True)
    generator = np.random.default_rng(0)
    place, taken = simulation.here, list[int]()
    for action in generator.integers(0, 4, 12).tolist():
        place = simulation.step(place, action)
        world.step(action)
        taken.append(action)
        elsewhere = simulation.step(simulation.here, action)  # away from it and back
        assert elsewhere.actions == (action,)
        np.testing.assert_array_equal(simulation.picture(place), world.frame)
        assert place.actions == tuple(taken)
    tried = simulation.tried
    simulation.follow(world)
    assert simulation.here.name == place.name
    assert simulation.tried == tried
    assert env.starts > 2


@pytest.mark.parametrize(("method", "said"), [("step", "in a control task, at the action"), ("reset", "of task 0")])
def test_what_an_environment_raises_in_a_task_is_a_sentence(method: str, said: str) -> None:
    class Ended(PlanarPush):
        """Goes on to nothing."""

    def ended(*_: Any, **__: Any) -> Any:
        raise AssertionError("the episode is over")

    env = PlanarPush()
    problem = away_from(env, env.reset(seed=0)[0], ControlTask(0, 0, 9), 0)
    setattr(Ended, method, ended)
    agent = make_reference("random", env.facts, Ended, CrossEntropy())
    with pytest.raises(RecordingFailed, match=rf"raised AssertionError in '{method}' .*{said}.*the episode is over"):
        control(agent, [problem], Ended, ControlSettings(steps=1))
