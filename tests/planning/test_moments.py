"""Moments: fixed sequences, and what each truly brings."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from planning import turning
from planning.turning import Turning

from dmotion_bench.actions import Continuous, Discrete, as_actions
from dmotion_bench.planning.dynamics.simulator import Simulation
from dmotion_bench.planning.moments import Moment, find_moment, fixed_sequences
from dmotion_bench.planning.tasks import Problem, World, load_problems, task_environment
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset

MOVES = Discrete(("up", "down", "left", "right"))
PUSH = Continuous(names=("dx", "dy"), low=(-0.1, -0.2), high=(0.1, 0.2), units=("m", "m"))
SEQUENCES = fixed_sequences(MOVES, 12, 4, 0)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    path = tmp_path_factory.mktemp("data") / "grid"
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=30, frames=32, tasks=5
    )
    record_dataset(path, recipe)
    return Dataset.open(path)


def _moment(dataset: Dataset, problem: Problem) -> Moment | None:
    actions = dataset.states(problem.task.episode).actions[problem.task.start :]
    return find_moment(problem, actions, SEQUENCES, lambda: task_environment(dataset.recipe))


def test_discrete_sequences_differ_and_hold_each_action_alone() -> None:
    sequences = fixed_sequences(MOVES, 64, 5, 0)

    assert sequences.shape == (64, 5)
    assert len(np.unique(sequences, axis=0)) == 64
    assert (sequences[:4] == np.arange(4)[:, None]).all()
    repeated = (sequences[4:, 1:] == sequences[4:, :-1]).mean()
    assert 0.5 < repeated < 0.75  # half by intent, and a quarter of the others by chance
    assert (sequences == fixed_sequences(MOVES, 64, 5, 0)).all()
    assert (sequences != fixed_sequences(MOVES, 64, 5, 1)).any()


def test_there_are_no_more_sequences_than_there_can_be() -> None:
    assert len(fixed_sequences(Discrete(("stay", "go")), 64, 3, 0)) == 8


def test_nearly_all_sequences_that_there_can_be_are_found_in_the_end() -> None:
    """The rarest of 4,096 has a probability of 8e-6."""
    sequences = fixed_sequences(MOVES, 4000, 6, 0)
    assert len(np.unique(sequences, axis=0)) == 4000


def test_continuous_sequences_are_in_their_bounds_and_often_go_on() -> None:
    sequences = fixed_sequences(PUSH, 200, 5, 0)

    assert sequences.shape == (200, 5, 2)
    assert np.abs(sequences).max() <= 1
    repeated = (sequences[:, 1:] == sequences[:, :-1]).all(axis=2).mean()
    assert 0.4 < repeated < 0.6


@pytest.mark.slow
def test_gains_are_those_of_a_simulator_in_which_the_sequence_is_carried_out(recorded: Dataset) -> None:
    checked = 0
    for problem in load_problems(recorded):
        moment = _moment(recorded, problem)
        if moment is None:
            continue
        walked = recorded.states(problem.task.episode).actions[problem.task.start :][: moment.offset]
        for sequence, after in zip(SEQUENCES, moment.after.tolist(), strict=True):
            world = World(task_environment(recorded.recipe), problem)
            for action in as_actions(walked):
                world.step(action)
            assert world.distance == pytest.approx(moment.now)
            for action in as_actions(sequence):
                world.step(action)
            assert world.distance == pytest.approx(after)
            checked += 1

    assert checked > 20


def test_the_moment_is_the_one_at_which_most_can_be_gained(recorded: Dataset) -> None:
    for problem in load_problems(recorded):
        moment = _moment(recorded, problem)
        gains = []
        world = World(task_environment(recorded.recipe), problem)
        walked = as_actions(recorded.states(problem.task.episode).actions[problem.task.start :])
        for offset in range(0, problem.task.goal - problem.task.start, 8):
            tried = []
            for sequence in SEQUENCES:
                other = World(task_environment(recorded.recipe), problem)
                for action in (*walked[:offset], *as_actions(sequence)):
                    other.step(action)
                tried.append(world.distance - other.distance)
            gains.append(max(tried))
            for action in walked[offset : offset + 8]:
                world.step(action)

        if max(gains) <= 0:
            assert moment is None
        else:
            assert moment is not None
            assert moment.best == pytest.approx(max(gains))
            assert moment.offset == 8 * int(np.argmax(gains))
        break


@pytest.mark.parametrize(
    "facts",
    [{}, {"settled": True}, {"tells_heading": False}, {"slides": True}, {"slides": True, "tells_heading": False}],
    ids=str,
)
def test_states_that_only_look_the_same_are_told_apart(facts: dict[str, bool]) -> None:
    sequences = np.array(list(itertools.product(range(3), repeat=4)))
    task = turning.problem(Turning())

    moment = find_moment(task, np.zeros(5, np.int64), sequences, lambda: Turning(**facts))

    assert moment is not None
    assert moment.best > 0
    for sequence, after in zip(sequences.tolist(), moment.after.tolist(), strict=True):
        world = World(Turning(**facts), task)
        for action in sequence:
            world.step(action)
        assert after == world.distance


def test_a_settled_world_is_tried_once_from_each_place() -> None:
    tried = []
    for settled in (True, False):
        env = Turning(settled=settled)
        simulation = Simulation(env, turning.problem(env))
        place = simulation.here
        for _ in range(8):
            place = simulation.step(place, turning.TURN)
        tried.append(simulation.tried)

    assert tried == [4, 8]
