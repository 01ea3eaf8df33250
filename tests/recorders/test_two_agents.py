"""Grid World with two agents: who moves first, what is impossible, and labels and bytes as in the world of one."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from recorders.expert_policy import ExpertPolicy
from recorders.grid_rules import JOINT_ACTIONS, act, legal_actions
from recorders.grid_things import FACTS, FACTS_OF_TWO, SECOND_AGENT
from recorders.grid_world import GridWorld
from recorders.policies import RandomPolicy
from recorders.push_policy import PushPolicy

Cell = tuple[int, int]
TWO = {"agents": 2, "version": 2}


def grid(first: Cell, second: Cell, *objects: Cell) -> tuple[np.ndarray, np.ndarray]:
    """A world with these agents and up to four objects; the others are gone."""
    gone = [(-9, -9)] * (4 - len(objects))
    cells = np.array([[first, *objects, *gone, second]])
    return cells, np.array([[True, *[True] * len(objects), *[False] * len(gone), True]])


def after(action: str, world: tuple[np.ndarray, np.ndarray]) -> list[Cell | None]:
    """Where agents and objects are, the agents first; None for what is gone. The action must be possible."""
    number = JOINT_ACTIONS.names.index(action)
    assert legal_actions(*world)[0, number], action
    cells, there = act(*world, np.array([number]))
    count = int(world[1].sum()) - 2
    order = [0, 5, *range(1, 1 + count)]
    return [tuple(cells[0, thing].tolist()) if there[0, thing] else None for thing in order]


def possible(action: str, world: tuple[np.ndarray, np.ndarray]) -> bool:
    return bool(legal_actions(*world)[0, JOINT_ACTIONS.names.index(action)])


def test_each_moves_its_own_way_and_pushes() -> None:
    assert after("right/up", grid((0, 0), (4, 4))) == [(1, 0), (4, 3)]
    assert after("right/left", grid((0, 0), (4, 4), (1, 0), (3, 4))) == [(1, 0), (3, 4), (2, 0), (2, 4)]
    assert after("down/left", grid((0, 3), (1, 0), (0, 4), (0, 0))) == [(0, 4), (0, 0), None, None]


def test_the_first_has_the_cell_that_both_want() -> None:
    assert not possible("right/left", grid((1, 2), (3, 2)))
    assert possible("right/right", grid((1, 2), (3, 2)))


def test_the_second_may_enter_the_cell_that_the_first_leaves_and_not_the_reverse() -> None:
    assert after("right/right", grid((2, 2), (1, 2))) == [(3, 2), (2, 2)]
    assert not possible("right/right", grid((1, 2), (2, 2)))  # the first moves first: the second is still there
    assert not possible("right/left", grid((1, 2), (2, 2)))  # so they cannot change places


def test_the_second_pushes_an_object_from_where_the_first_has_pushed_it_to() -> None:
    assert after("right/up", grid((1, 2), (3, 3), (2, 2))) == [(2, 2), (3, 2), (3, 1)]
    assert after("right/down", grid((0, 0), (2, 1), (1, 0))) == [(1, 0), (2, 2), (2, 0)]


def test_no_agent_is_pushed_directly_or_through_objects() -> None:
    world = grid((0, 0), (3, 0), (1, 0), (2, 0))
    assert not any(possible(f"right/{second}", world) for second in ("up", "down", "left", "right"))
    assert possible("down/right", world)
    assert not possible("down/left", grid((1, 3), (2, 4), (1, 4)))  # the object is pushed off; the first is there now
    assert not possible("down/left", grid((0, 0), (3, 1), (1, 1), (2, 1)))  # the chain ends at where the first is now


@settings(deadline=None, derandomize=True, max_examples=60)
@given(places=st.permutations(range(25)), left=st.integers(0, 4))
def test_something_is_always_possible_and_nothing_overlaps(places: list[int], left: int) -> None:
    cells = [(place % 5, place // 5) for place in places[: 2 + left]]
    world = grid(cells[0], cells[1], *cells[2:])
    legal = np.flatnonzero(legal_actions(*world)[0])
    assert len(legal)
    for action in legal.tolist():
        moved, there = act(*world, np.array([action]))
        present = [tuple(cell) for cell in moved[0][there[0]].tolist()]
        assert len(set(present)) == len(present)
        assert there[0, 0]
        assert there[0, 5]
        for agent, part in zip((0, 5), JOINT_ACTIONS.names[action].split("/"), strict=True):
            way = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}[part]
            assert (moved[0, agent] - world[0][0, agent]).tolist() == list(way)  # so an agent's action is its motion


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=10)
@given(seeds=st.lists(st.integers(0, 2**62), min_size=1, max_size=3), scene=st.sampled_from(["clean", "distracted"]))
def test_all_at_once_equals_step_by_step(seeds: list[int], scene: str) -> None:
    parameters = {**TWO, "scene": scene}
    together = GridWorld.generate(seeds, frames=12, policy="random", parameters=parameters)
    for seed, episode in zip(seeds, together, strict=True):
        alone = record_episode(GridWorld(**parameters), RandomPolicy(), seed, 12)
        np.testing.assert_array_equal(episode.frames, alone.frames)
        for name in ("actions", "pushed", "masks"):
            np.testing.assert_array_equal(getattr(episode.labels, name), getattr(alone.labels, name))
        for name in ("agent", "objects"):
            for one, other in zip(
                dataclasses.astuple(getattr(episode.labels, name)),
                dataclasses.astuple(getattr(alone.labels, name)),
                strict=True,
            ):
                np.testing.assert_array_equal(one, other)


def test_masks_and_states_say_where_each_agent_is() -> None:
    (episode,) = GridWorld.generate([3], frames=20, policy="random", parameters=TWO)
    labels = episode.labels
    assert FACTS_OF_TWO.agents == (FACTS.agent, SECOND_AGENT)
    assert FACTS_OF_TWO.agent_masks == (1, 6)
    assert labels.agent.position.shape == (20, 2, 3)
    for number, (look, mask) in enumerate(zip(FACTS_OF_TWO.agents, FACTS_OF_TWO.agent_masks, strict=True)):
        shown = (episode.frames == look.color).all(-1)
        assert shown.any((1, 2)).all()
        np.testing.assert_array_equal(labels.masks == mask, shown)
        for moment in range(20):
            ys, xs = np.nonzero(shown[moment])
            np.testing.assert_allclose(labels.agent.pixel[moment, number], (xs.mean(), ys.mean()))
    parts = JOINT_ACTIONS.divided(labels.actions)
    moves = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])
    np.testing.assert_array_equal(np.diff(labels.agent.position[..., :2], axis=0), moves[parts])


def test_the_second_agent_joins_the_scene_of_one() -> None:
    one, two = GridWorld(version=2), GridWorld(**TWO)
    for seed in range(20):
        one.reset(seed=seed)
        two.reset(seed=seed)
        np.testing.assert_array_equal(two.objects().position, one.objects().position)
        np.testing.assert_array_equal(two.agent().position[:1], one.agent().position)


def _record(path: Path, workers: int) -> Dataset:
    recipe = DatasetRecipe(
        environment="grid_world", parameters=TWO, episodes=10, frames=12, tasks=2, shard_episodes=3, seed=5
    )
    record_dataset(path, recipe, make_executor("local", workers))
    return Dataset.open(path)


def _bytes(path: Path) -> dict[str, str]:
    files = (file for file in path.rglob("*") if file.is_file() and "cache" not in file.parts)
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


@pytest.mark.slow
def test_a_recording_is_the_same_for_any_workers_and_reads_back(tmp_path: Path) -> None:
    alone = _record(tmp_path / "one", 1)
    _record(tmp_path / "two", 2)
    assert _bytes(tmp_path / "one") == _bytes(tmp_path / "two")
    assert alone.spec == FACTS_OF_TWO
    assert not check_dataset(alone.path).damages
    (episode,) = GridWorld.generate([alone.rows[4].seed], frames=12, policy="random", parameters=TWO)
    read = alone.labels(4)
    np.testing.assert_array_equal(read.agent.position, episode.labels.agent.position)
    np.testing.assert_array_equal(read.masks, episode.labels.masks)


def test_what_knows_one_agent_says_so() -> None:
    env = GridWorld(**TWO)
    env.reset(seed=0)
    for policy in (PushPolicy(), ExpertPolicy()):
        with pytest.raises(InvalidSetting, match="moves one agent, and grid_world has 2 here; record"):
            policy(env, np.random.default_rng(0))
    with pytest.raises(InvalidSetting, match="the reference 'scripted' moves one agent"):
        env.script()
    with pytest.raises(InvalidSetting, match="agents is 3; Grid World has 1 agent or 2"):
        GridWorld(agents=3)
