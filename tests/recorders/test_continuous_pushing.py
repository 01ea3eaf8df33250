"""Both pushing environments with continuous actions: exactness, displacements, bounds, labels, restoring."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Restorable
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe, Episode
from dmotion_bench.storage.dataset import Dataset
from recorders.planar_push import PlanarPush
from recorders.push_policy import PushPolicy
from recorders.pushing import PushingEnvironment
from recorders.robot_push import RobotPush

KINDS = {"robot_push": RobotPush, "planar_push": PlanarPush}


@pytest.fixture(scope="module", params=KINDS)
def env(request: pytest.FixtureRequest) -> Iterator[PushingEnvironment]:
    made = KINDS[request.param](actions="continuous")
    yield made
    made.close()


@pytest.fixture(scope="module")
def episodes(env: PushingEnvironment) -> list[Episode]:
    return [record_episode(env, PushPolicy(), seed, frames=60) for seed in range(6)]


def _reach(env: PushingEnvironment) -> np.ndarray:
    assert isinstance(env.facts.actions, Continuous)
    return np.asarray(env.facts.actions.high)


@pytest.mark.slow
def test_gymnasium_finds_nothing_wrong(env: PushingEnvironment) -> None:
    check_env(env.unwrapped, skip_render_check=True)  # warnings are errors
    assert env.action_space.shape == (2,)
    np.testing.assert_allclose(env.action_space.high, env.lattice.step)


@pytest.mark.slow
def test_a_command_is_the_displacement_that_follows_it(env: PushingEnvironment, episodes: list[Episode]) -> None:
    assert env.facts.actions is not None
    for episode in episodes:
        moved = np.diff(episode.labels.agent.position[:, 0, :2], axis=0)
        np.testing.assert_allclose(moved, episode.labels.actions, atol=1e-12)
        assert env.facts.actions.fault(episode.labels.actions) is None


@pytest.mark.slow
def test_replaying_the_commands_gives_the_frames(env: PushingEnvironment, episodes: list[Episode]) -> None:
    other = KINDS[env.facts.id](actions="continuous")
    for episode in episodes[:2]:
        frame, _ = other.reset(seed=episode.seed)
        np.testing.assert_array_equal(frame, episode.frames[0])
        for action, expected in zip(episode.labels.actions, episode.frames[1:], strict=True):
            frame, _, _, _, info = other.step(action)
            assert not info["illegal"]
            np.testing.assert_array_equal(frame, expected)
    other.close()


def test_the_policy_moves_freely_and_pushes_about_as_often_as_with_four_directions(episodes: list[Episode]) -> None:
    actions = np.concatenate([episode.labels.actions for episode in episodes])
    pushed = np.concatenate([episode.labels.pushed for episode in episodes])
    assert 0.15 < pushed.mean() < 0.6
    assert len(np.unique(actions, axis=0)) > 0.9 * len(actions)
    assert (actions.min(0) < 0).all()
    assert (actions.max(0) > 0).all()


def test_a_full_step_along_an_axis_is_the_discrete_action(env: PushingEnvironment) -> None:
    other = KINDS[env.facts.id]()
    for seed in range(3):
        frames = [made.reset(seed=seed)[0] for made in (env, other)]
        np.testing.assert_array_equal(*frames)
        for action in np.flatnonzero(other.legal_actions())[:2]:
            if other.legal_actions()[action]:
                np.testing.assert_array_equal(env.step(other.moves[action])[0], other.step(int(action))[0])
    other.close()


def test_at_the_edge_a_displacement_is_cut_short(env: PushingEnvironment) -> None:
    env.reset(seed=3)
    reach = _reach(env)
    illegal = [env.step(reach)[4]["illegal"] for _ in range(20)]
    assert not illegal[0] or (env.room[1] < reach).any()
    assert illegal[-1]
    before = env.agent().position.copy()
    np.testing.assert_allclose(env.room[1], 0, atol=1e-12)
    env.step(reach)
    np.testing.assert_array_equal(env.agent().position, before)
    assert not env.step(-reach / 3)[4]["illegal"]
    np.testing.assert_allclose(before[0, :2] - env.agent().position[0, :2], reach / 3, atol=1e-12)


@pytest.mark.parametrize("wrong", [(1.0, 0.0), (np.nan, 0.0), (0.01,), (0.0, 0.0, 0.0)])
def test_an_action_that_cannot_be_is_a_sentence_and_changes_nothing(env: PushingEnvironment, wrong: tuple) -> None:
    env.reset(seed=1)
    before = env.agent().position.copy()
    with pytest.raises(InvalidSetting, match=f"{env.facts.id!r} was given .* an action is dx"):
        env.step(np.array(wrong))
    np.testing.assert_array_equal(env.agent().position, before)


def test_a_restored_state_goes_on_as_it_did(env: PushingEnvironment) -> None:
    assert isinstance(env, Restorable)
    env.reset(seed=2)
    generator, policy = np.random.default_rng(0), PushPolicy()
    for _ in range(8):
        env.step(policy(env, generator))
    snapshot, action = env.snapshot(), _reach(env) * [0.4, -0.3]
    first = env.step(action)[0], env.objects().position, env.agent().position
    env.step(-action)
    env.restore(snapshot)
    again = env.step(action)[0], env.objects().position, env.agent().position
    np.testing.assert_array_equal(first[2], again[2])
    np.testing.assert_allclose(first[1], again[1], atol=1e-4)
    assert np.abs(first[0].astype(int) - again[0]).mean() < 0.5


def test_an_unknown_kind_of_actions_is_refused() -> None:
    with pytest.raises(UnknownName, match="no kind of actions named 'continous'; did you mean 'continuous'"):
        PlanarPush(actions="continous")


def test_any_number_of_workers_records_the_same_bytes(tmp_path: Path) -> None:
    recipe = DatasetRecipe(
        environment="planar_push",
        parameters={"actions": "continuous"},
        policy="push",
        episodes=4,
        frames=12,
        shard_episodes=2,
    )
    record_dataset(tmp_path / "one", recipe)
    record_dataset(tmp_path / "two", recipe, executor=make_executor("local", 2))
    one, other = Dataset.open(tmp_path / "one"), Dataset.open(tmp_path / "two")
    assert one.fingerprint == other.fingerprint
    for file in sorted((tmp_path / "one" / "labels").iterdir()):
        assert file.read_bytes() == (tmp_path / "two" / "labels" / file.name).read_bytes()
    assert one.labels(0).actions.shape == (one.lengths[0] - 1, 2)
