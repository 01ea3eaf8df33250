"""The control loop in Grid World, where a model that knows the rules can be had without training."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from planning.worlds import PerfectGridModel, tracking

from dmotion_bench.actions import Discrete
from dmotion_bench.environment import Environment
from dmotion_bench.errors import (
    DatasetError,
    DmbenchError,
    InvalidSetting,
    ModelContractBroken,
    UnknownName,
)
from dmotion_bench.planning.agents import (
    NO_ACTION,
    Decision,
    IdleAgent,
    ModelAgent,
    OracleAgent,
    RandomAgent,
    make_reference,
)
from dmotion_bench.planning.mpc import ControlProgress, ControlResult, ControlSettings, control
from dmotion_bench.planning.objectives.tracked import Tracked
from dmotion_bench.planning.solvers.base import PlanContext
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.planning.solvers.exhaustive import Exhaustive
from dmotion_bench.planning.tasks import ObjectDistances, Problem, World, load_problems, start, task_environment
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring, control_samples, score_control
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from recorders.grid_rules import ACTIONS
from recorders.grid_things import FACTS
from recorders.grid_world import GridWorld

pytestmark = pytest.mark.slow

SMALL = CrossEntropy(samples=12, horizon=4, iterations=2, elites=4)


def solve(agent: Any, problems: list[Problem], **settings: Any) -> ControlResult:
    return control(agent, problems, GridWorld, ControlSettings(**settings))


class Still(GridWorld):
    """Its objects are where they are put."""

    positions: np.ndarray

    def objects(self) -> Any:
        return replace(super().objects(), position=self.positions)


def measured(problem: Problem) -> ObjectDistances:
    return ObjectDistances(problem.start_objects, problem.goal_objects)


def test_a_problem_starts_where_it_was_recorded(dataset: Dataset, problems: list[Problem]) -> None:
    assert len(problems) == 6
    for problem in problems:
        labels, video = dataset.labels(problem.task.episode), dataset.video(problem.task.episode)
        env = GridWorld()
        np.testing.assert_array_equal(start(env, problem), video[problem.task.start])
        np.testing.assert_array_equal(env.objects().position, labels.objects.position[problem.task.start])
        np.testing.assert_array_equal(problem.goal_frame, video[problem.task.goal])
        recorded = labels.actions[problem.task.start : problem.task.goal].tolist()
        np.testing.assert_array_equal(start(env, problem, recorded), problem.goal_frame)
        assert World(env, problem).distance == pytest.approx(1)
        start(env, problem, recorded)
        assert measured(problem).distance(env) == 0


def test_the_distance_is_a_share_of_the_initial_one_and_a_lost_object_costs_one(problems: list[Problem]) -> None:
    problem = problems[0]
    measure, env = measured(problem), Still()
    for positions, distance in (
        (problem.start_objects.position, 1),
        (problem.goal_objects.position, 0),
        ((problem.start_objects.position + problem.goal_objects.position) / 2, 0.5),
    ):
        env.positions = positions
        assert measure.distance(env) == pytest.approx(distance)
    assert measure.cost(env) > 0
    there = int(np.flatnonzero(~np.isnan(problem.goal_objects.position[:, 0]))[0])
    env.positions = problem.goal_objects.position.copy()
    assert measure.cost(env) == 0
    env.positions[there] = np.nan
    assert (measure.distance(env), measure.lost(env)) == (1, 1)


class Drawer(GridWorld):
    """Judges its tasks itself: by the agent's column, whatever the objects do."""

    def task_measure(self, start: Any, goal: Any) -> Any:
        assert start.position.shape == goal.position.shape == (4, 3)
        return self

    def distance(self, env: Environment) -> float:
        return float(env.agent().position[0, 0])

    def lost(self, env: Environment) -> int:
        return 7

    def cost(self, env: Environment) -> float:
        return self.distance(env) ** 2


class Unsure(Drawer):
    """Does not know how far it is once the agent has left its column."""

    def distance(self, env: Environment) -> float:
        there = super().distance(env)
        return float("nan") if there != self.began else there

    def reset(self, **options: Any) -> Any:
        found = super().reset(**options)
        self.began = super().distance(self)
        return found


def test_a_distance_that_is_no_number_is_said_and_not_left_out(problems: list[Problem]) -> None:
    match = "judges task 0 to be nan away from its goal"
    with pytest.raises(DmbenchError, match=match):
        control(RandomAgent(ACTIONS), problems[:1], Unsure, ControlSettings(steps=40))
    with pytest.raises(DmbenchError, match=match):
        control(OracleAgent(FACTS, Exhaustive(horizon=2), Unsure), problems[:1], Unsure, ControlSettings(steps=1))


def test_an_environment_may_judge_its_tasks_itself(problems: list[Problem]) -> None:
    oracle = OracleAgent(FACTS, Exhaustive(horizon=2), Drawer)
    result = control(oracle, problems[:2], Drawer, ControlSettings(steps=5))
    assert (result.lost == 7).all()
    assert (result.distance[:, -1] == result.distance.min()).all()  # the oracle goes to the first column
    assert result.distance.min() < result.distance[:, 0].max()


def test_doing_nothing_stays_at_one(problems: list[Problem]) -> None:
    result = solve(IdleAgent(ACTIONS), problems, steps=5)
    np.testing.assert_array_equal(result.distance, 1)
    np.testing.assert_array_equal(result.actions, NO_ACTION)
    assert figures_of(control_samples("idle", result), "idle")["control_distance[5]"].mean == 1


def test_a_perfect_model_solves_what_random_actions_do_not(problems: list[Problem]) -> None:
    solver = CrossEntropy(samples=20, horizon=5, iterations=2, elites=5)
    solved = solve(tracking(solver), problems, steps=12)
    lucky = solve(RandomAgent(ACTIONS), problems, steps=12)
    assert solved.distance.shape == (6, 13)
    assert solved.distance[:, -1].mean() < 0.6 < lucky.distance[:, -1].mean()
    assert solved.lost.sum() <= lucky.lost.sum()


def test_a_perfect_model_and_the_oracle_do_the_same(problems: list[Problem]) -> None:
    """The oracle looks into the simulator what the model draws: the same frames, so the same plans."""
    imagined = solve(tracking(SMALL), problems[:3], steps=8)
    true = solve(OracleAgent(FACTS, SMALL, GridWorld, objective=Tracked()), problems[:3], steps=8)
    np.testing.assert_array_equal(imagined.actions, true.actions)
    np.testing.assert_array_equal(imagined.distance, true.distance)
    assert imagined.frames == true.frames


@pytest.fixture(scope="module")
def together(problems: list[Problem]) -> ControlResult:
    return solve(tracking(SMALL), problems, steps=4, group=6)


@pytest.mark.parametrize("group", [1, 4])
def test_tasks_side_by_side_are_the_same_as_one_by_one(
    problems: list[Problem], together: ControlResult, group: int
) -> None:
    grouped = solve(tracking(SMALL), problems, steps=4, group=group)
    np.testing.assert_array_equal(together.actions, grouped.actions)
    np.testing.assert_array_equal(together.distance, grouped.distance)
    assert together.frames == grouped.frames


def test_the_seed_decides(problems: list[Problem]) -> None:
    first, again, other = (solve(RandomAgent(ACTIONS), problems[:2], steps=10, seed=seed).actions for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


class OtherStateBehindTheSameImages(GridWorld):
    """Grid World as always, until the task begins; then another state behind the very same pictures.

    From then on the frames are those of a film, and everything that could be asked of the simulator is a lie.
    """

    def __init__(self, film: list[np.ndarray], opening: int) -> None:
        super().__init__()
        self.film, self.opening, self.taken = film, opening, 0

    def reset(self, **options: Any) -> Any:
        self.taken = 0
        return super().reset(**options)

    def step(self, action: int) -> Any:
        self.taken += 1
        result = super().step(action)
        if self.taken <= self.opening:
            return result
        self._cells = np.roll(self._cells, 1, axis=0)  # not at all where the picture has them
        return (self.film[self.taken - self.opening - 1], *result[1:])


def test_a_model_agent_uses_images_only(problems: list[Problem]) -> None:
    problem = problems[0]
    agent = tracking(SMALL)
    film: list[np.ndarray] = []
    honest = control(
        agent,
        [problem],
        GridWorld,
        ControlSettings(steps=6),
        watch=lambda scene: film.append(scene.worlds[0].frame) if scene.context.observation.step else None,
    )
    film.append(film[-1])
    masked = control(
        agent,
        [problem],
        lambda: OtherStateBehindTheSameImages(film, len(problem.opening)),
        ControlSettings(steps=6),
    )
    np.testing.assert_array_equal(honest.actions, masked.actions)
    assert (honest.distance[:, 1:] != masked.distance[:, 1:]).any()  # the simulator's state was another


def test_the_first_image_is_given_twice_and_only_changes_count(problems: list[Problem]) -> None:
    seen: list[PlanContext] = []

    class Into(RandomAgent):
        """Down, until the wall and on."""

        def act(self, one: PlanContext) -> Decision:
            seen.append(one)
            return Decision(action=np.array([1]))

    solve(Into(ACTIONS), problems[:1], steps=8)
    first, last = seen[0].observation, seen[-1].observation
    np.testing.assert_array_equal(first.previous, first.current)
    np.testing.assert_array_equal(first.current[0], problems[0].start_frame)
    assert seen[-1].blocked.tolist() == [[False, True, False, False]]  # at the wall
    assert (last.previous != last.current).any()
    for before, after in itertools.pairwise(seen):
        if (before.observation.current != after.observation.current).any():
            np.testing.assert_array_equal(after.observation.previous, before.observation.current)
            assert not after.blocked.any()


def test_figures_are_means_over_tasks(dataset: Dataset) -> None:
    reports: list[ControlProgress] = []
    result = score_control("random", dataset, ControlScoring(steps=12), progress=reports.append)
    figures = figures_of(control_samples("random", result), "random")
    assert list(figures) == [
        *(f"control_distance[{step}]" for step in range(1, 13)),
        "control_success",
        "control_success[0.1]",
        "control_success[0.2]",
        "control_success[0.5]",
        "control_lost",
    ]
    assert figures["control_distance[12]"].mean == pytest.approx(result.distance[:, 12].mean())
    assert figures["control_distance[12]"].std == pytest.approx(result.distance[:, 12].std())
    assert figures["control_success[0.5]"].mean == (result.distance[:, 12] <= 0.5).mean()
    assert all(figure.n == 6 for figure in figures.values())
    assert reports[-1].steps == reports[-1].total == 72
    assert reports[-1].distance == pytest.approx(result.distance[:, -1].mean())


def test_no_tasks_are_no_error() -> None:
    result = control(IdleAgent(ACTIONS), [], GridWorld, ControlSettings(steps=3))
    assert result.distance.shape == result.lost.shape == (0, 4)
    assert result.tasks == ()


def test_mistakes_get_sentences(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match=r"no reference named 'orakel'; did you mean 'oracle'\?"):
        make_reference("orakel", FACTS, GridWorld, SMALL)
    with pytest.raises(UnknownName, match="no task named '6'; known: 0 to 5"):
        load_problems(dataset, [6])
    with pytest.raises(UnknownName, match="no planner named 'cen'; did you mean 'cem'"):
        ControlScoring(planner="cen")
    with pytest.raises(InvalidSetting, match="tasks is 0"):
        ControlScoring(tasks=0)
    for wrong in ({"steps": 0}, {"group": 0}, {"seed": -1}):
        with pytest.raises(InvalidSetting, match=next(iter(wrong))):
            ControlScoring(**wrong)
        with pytest.raises(InvalidSetting, match=next(iter(wrong))):
            ControlSettings(**wrong)
    random = DatasetRecipe(environment="grid_world", policy="random", episodes=2, frames=4)
    record_dataset(tmp_path / "none", random)
    with pytest.raises(DatasetError, match="'dmbench record grid_world --set version=1 --tasks 20'"):
        load_problems(Dataset.open(tmp_path / "none"))
    model = PerfectGridModel()
    model.inputs = type(model.inputs)(height=128, width=128, actions=Discrete.numbered(2))
    with pytest.raises(ModelContractBroken, match="made for 2 actions, and 'grid_world' has 4"):
        ModelAgent(model, FACTS, SMALL, Tracked())


def test_a_simulator_that_does_not_repeat_the_recording_is_noticed(problems: list[Problem]) -> None:
    class OtherVersion(GridWorld):
        def reset(self, **options: Any) -> Any:
            return super().reset(seed=options["seed"] + 1)

    with pytest.raises(DatasetError, match="does not reproduce the recording"):
        control(IdleAgent(ACTIONS), problems[:1], OtherVersion)


def test_the_oracle_tries_things_out_in_a_simulator_of_its_own(problems: list[Problem]) -> None:
    made: list[Environment] = []

    closed: list[Environment] = []

    class Closing(GridWorld):
        def close(self) -> None:
            closed.append(self)
            super().close()

    def make() -> Environment:
        made.append(Closing())
        return made[-1]

    agent = OracleAgent(FACTS, Exhaustive(horizon=2), make)
    scenes: list[bytes] = []
    control(
        agent,
        problems[:1],
        make,
        ControlSettings(steps=3),
        watch=lambda scene: scenes.append(scene.worlds[0].frame.tobytes()),
    )
    assert len(made) == 2
    assert sorted(map(id, closed)) == sorted(map(id, made))
    replayed = [problems[0].start_frame.tobytes()]
    assert scenes[0] == replayed[0]
    assert torch.get_num_threads() >= 1


def test_task_environment_is_the_recorded_one(dataset: Dataset) -> None:
    assert isinstance(task_environment(dataset.recipe), GridWorld)
    assert json.loads(json.dumps(dataset.recipe.parameters)) == {}
