"""Grid World is the paper's: its episodes, its pictures, and the figures of reference predictors on it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import UInt8

from dmotion_bench.environment import Environment, EpisodeGenerator, Versioned
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.specs import Episode, EpisodeLabels, ObjectStates, episode_seed
from recorders.grid_drawing import SPANS, Version
from recorders.grid_rules import CELLS
from recorders.grid_things import FACTS, draw
from recorders.grid_world import GridWorld
from recorders.policies import RandomPolicy

UP = 0
versions: Callable[..., Any] = pytest.mark.parametrize("version", [1, 2])


def test_gymnasium_finds_nothing_wrong() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("dmbench/GridWorld-v2", render_mode="rgb_array")
        check_env(env.unwrapped)
        env.close()
    assert isinstance(env.unwrapped, Environment)
    assert isinstance(GridWorld, EpisodeGenerator)
    assert isinstance(GridWorld, Versioned)
    with pytest.raises(InvalidSetting, match="version is 3; it can be 1, 2"):
        GridWorld(version=3)


@pytest.mark.parametrize("action", [-1, 4, 99])
def test_what_is_no_action_is_refused(action: int) -> None:
    env = GridWorld()
    env.reset(seed=1)
    with pytest.raises(InvalidSetting, match=f"was given the action {action}; it has 0 to 3"):
        env.step(action)


def test_an_illegal_move_changes_nothing_and_says_so() -> None:
    env = GridWorld()
    before, _ = env.reset(seed=1)
    while env.legal_actions()[UP]:
        before, *_ = env.step(UP)
    after, _, _, _, info = env.step(UP)
    assert info == {"illegal": True}
    np.testing.assert_array_equal(after, before)


@pytest.mark.slow
@versions
@settings(deadline=None, derandomize=True, max_examples=25)
@given(seeds=st.lists(st.integers(0, 2**62), min_size=1, max_size=4), frames=st.integers(2, 40))
def test_all_at_once_equals_step_by_step(version: Version, seeds: list[int], frames: int) -> None:
    together = list(GridWorld.generate(seeds, frames=frames, policy="random", parameters={"version": version}))
    for seed, episode in zip(seeds, together, strict=True):
        assert_equal(episode, record_episode(GridWorld(version=version), RandomPolicy(), seed, frames))


@versions
@settings(deadline=None, derandomize=True, max_examples=25)
@given(seed=st.integers(0, 2**62))
def test_an_action_is_taken_at_its_frame(version: Version, seed: int) -> None:
    """x_{t+1} = step(x_t, a_t): replaying the labels gives the video."""
    (episode,) = GridWorld.generate([seed], frames=20, policy="random", parameters={"version": version})
    env = GridWorld(version=version)
    frame, _ = env.reset(seed=seed)
    np.testing.assert_array_equal(frame, episode.frames[0])
    for action, after in zip(episode.labels.actions, episode.frames[1:], strict=True):
        assert env.legal_actions()[action]
        frame, _, terminated, truncated, info = env.step(int(action))
        assert (terminated, truncated, info) == (False, False, {"illegal": False})
        np.testing.assert_array_equal(frame, after)


@pytest.mark.slow
@versions
@settings(deadline=None, derandomize=True, max_examples=10)
@given(seed=st.integers(0, 2**62))
def test_labels_say_what_the_picture_shows(version: Version, seed: int) -> None:
    (episode,) = GridWorld.generate([seed], frames=32, policy="random", parameters={"version": version})
    labels, spans = episode.labels, SPANS[version]
    assert labels.agent.position.shape == (32, 1, 3)
    for thing, (look, states, place) in enumerate(
        [(FACTS.agent, labels.agent, 0), *((one, labels.objects, k) for k, one in enumerate(FACTS.objects))]
    ):
        shown = (episode.frames == look.color).all(-1)
        np.testing.assert_array_equal(labels.masks == thing + 1, shown)
        for moment in range(32):
            visible = states.visible[moment, place]
            assert (visible > 0) == shown[moment].any()
            if visible:
                ys, xs = np.nonzero(shown[moment])
                np.testing.assert_allclose(states.pixel[moment, place], (xs.mean(), ys.mean()))
                x, y, z = states.position[moment, place]
                assert spans[int(x)].start <= xs.min() <= xs.max() < spans[int(x)].stop
                assert spans[int(y)].start <= ys.min() <= ys.max() < spans[int(y)].stop
                assert z == 0
                assert visible == pytest.approx(len(xs) / (alone(thing, int(x), int(y), version) == thing + 1).sum())
            else:
                assert np.isnan(states.position[moment, place]).all()
    changed = np.array([not same_objects(labels.objects, moment) for moment in range(31)])
    np.testing.assert_array_equal(labels.pushed, changed)


def alone(thing: int, column: int, row: int, version: Version) -> UInt8[np.ndarray, "h w"]:
    """The mask of a thing that nothing else is near."""
    return draw(np.array([[(column, row)] * 5]), np.arange(5)[None] == thing, version).masks[0]


@versions
def test_every_shape_fills_its_cell(version: Version) -> None:
    """A triangle's tip may fall between two rows or columns of pixels."""
    spans = SPANS[version]
    for column in range(CELLS):
        for row in range(CELLS):
            for thing in range(5):
                ys, xs = np.nonzero(alone(thing, column, row, version))
                if thing == 0 or version == 1:
                    assert (xs.min(), xs.max() + 1) == (spans[column].start, spans[column].stop)
                assert spans[column].start <= xs.min() <= spans[column].start + 1
                assert spans[column].stop - 1 <= xs.max() + 1 <= spans[column].stop
                assert spans[row].start <= ys.min() <= spans[row].start + 1
                assert ys.max() + 1 == spans[row].stop


def test_its_light_does_not_vary_and_a_policy_must_be_one_of_its_own() -> None:
    with pytest.raises(UnknownName, match="no factor of variation named 'light'; known: background"):
        GridWorld().reset(seed=0, options={"vary": ["light"]})
    with pytest.raises(UnknownName, match="no policy of grid_world named 'push'"):
        list(GridWorld.generate([0], frames=3, policy="push", parameters={}))


@pytest.mark.parametrize("agents", [1, 2])
def test_a_restored_or_undrawn_state_goes_on_like_the_original(agents: int) -> None:
    stepped, advanced = GridWorld(agents=agents), GridWorld(agents=agents)
    for env in (stepped, advanced):
        env.reset(seed=3)
    generator = np.random.default_rng(0)
    for _ in range(40):
        start = stepped.snapshot()
        action = int(generator.integers(len(stepped.facts.actions or ())))
        frame, *_, info = stepped.step(action)
        assert advanced.advance(action) == info["illegal"]
        np.testing.assert_array_equal(advanced.objects().position, stepped.objects().position)
        np.testing.assert_array_equal(advanced.render(), frame)
        np.testing.assert_array_equal(advanced.masks(), stepped.masks())
        advanced.step(int(generator.integers(4)))  # it has been elsewhere
        advanced.restore(start)
        np.testing.assert_array_equal(advanced.step(action)[0], frame)
        np.testing.assert_array_equal(advanced.objects().pixel, stepped.objects().pixel)


@pytest.mark.parametrize("policy", ["object-directed", "expert-correlated"])
def test_episodes_of_other_policies_are_stepped(policy: str) -> None:
    (generated,) = GridWorld.generate([4], frames=9, policy=policy, parameters={"version": 2})
    stepped = record_episode(GridWorld(version=2), GridWorld.policies[policy](), 4, frames=9)
    np.testing.assert_array_equal(generated.frames, stepped.frames)
    np.testing.assert_array_equal(generated.labels.actions, stepped.labels.actions)


@pytest.mark.slow
@versions
def test_reference_predictors_have_the_papers_errors(version: Version) -> None:
    """facts.md, 1: MSE 1848 +- 438 for copying the last frame, 3666 for all black (there over 2,100 triplets)."""
    seeds = [episode_seed(0, number) for number in range(200)]
    copied, black = [], []
    for episode in GridWorld.generate(seeds, frames=32, policy="random", parameters={"version": version}):
        frames = episode.frames
        assert set(np.unique(frames)) == {0, 255}  # so a squared error is 0 or 255 squared
        copied.append(255.0**2 * (frames[2:] != frames[1:-1]).mean((1, 2, 3)))
        black.append(255.0**2 * (frames[2:] != 0).mean((1, 2, 3)))
    assert np.mean(copied) == pytest.approx(1848, rel=0.02)
    assert np.std(copied) == pytest.approx(438, abs=60)
    assert np.mean(black) == pytest.approx(3666, rel=0.03)


@pytest.mark.slow
def test_pushes_and_losses_are_as_often_as_in_the_paper() -> None:
    """facts.md, 1: a push in 10% of the triplets, a loss in 3.4%, objects fall from 4.0 to 2.85."""
    seeds = [episode_seed(1, number) for number in range(700)]
    pushes, losses, left = [], [], []
    for episode in GridWorld.generate(seeds, frames=32, policy="random", parameters={}):
        there = episode.labels.objects.visible
        assert there[0].sum() == 4
        pushes.append(episode.labels.pushed[1:])
        losses.append(there[1:-1].sum(-1) > there[2:].sum(-1))
        left.append(there[-1].sum())
    assert np.mean(pushes) == pytest.approx(0.10, abs=0.01)
    assert np.mean(losses) == pytest.approx(0.034, abs=0.005)
    assert np.mean(left) == pytest.approx(2.85, abs=0.1)


def same_objects(objects: ObjectStates, moment: int) -> bool:
    return np.array_equal(objects.position[moment], objects.position[moment + 1], equal_nan=True)


def assert_equal(left: Episode, right: Episode) -> None:
    np.testing.assert_array_equal(left.frames, right.frames)
    assert (left.seed, left.ended) == (right.seed, right.ended)
    assert isinstance(left.labels, EpisodeLabels)
    for name in ("actions", "pushed", "masks"):
        np.testing.assert_array_equal(getattr(left.labels, name), getattr(right.labels, name))
    for name in ("position", "orientation", "pixel", "visible"):
        for who in ("agent", "objects"):
            np.testing.assert_array_equal(
                getattr(getattr(left.labels, who), name), getattr(getattr(right.labels, who), name)
            )
