"""A simulator that begins a new episode by itself would have its first frame recorded as what an action led to."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import pytest
import strange_worlds
from strange_worlds import SLIDER

from dmotion_bench.errors import RecordingFailed
from dmotion_bench.registry import environment_class
from recorders.gymnasium_env.resets import Resets

strange_worlds.register()
AUTORESET = "gymnasium.wrappers:Autoreset"
ITSELF = "began a new episode by itself at step {} of the episode with seed 3, where one had ended"


class AtOnce(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Is reset within the step that ends an episode."""

    def step(self, action: Any) -> Any:
        told = super().step(action)
        if told[2] or told[3]:
            self.env.reset()
        return told


def _slider(**parameters: Any) -> Any:
    env: Any = environment_class(SLIDER)(frame_size=24, places=48, max_episode_steps=6, **parameters)
    env.reset(seed=3)
    return env


def test_within_skipped_frames_a_new_episode_is_refused_and_a_time_limit_is_not() -> None:
    plain, own = _slider(action_repeat=4), _slider(action_repeat=4, wrappers=AUTORESET)
    for env in (plain, own):
        assert env.step(0)[3] is False
    assert plain.step(0)[3] is True
    with pytest.raises(RecordingFailed, match=ITSELF.format(7) + ".*Autoreset'.*--set max_episode_steps=1000"):
        own.step(0)
    own.reset(seed=3)
    own.step(0)


def test_a_recorded_episode_ends_before_it_and_a_task_that_goes_on_is_refused() -> None:
    plain, own = _slider(), _slider(wrappers=AUTORESET)
    for env in (plain, own):
        assert [env.step(0)[3] for _ in range(6)] == [False] * 5 + [True]
    plain.step(0)
    with pytest.raises(RecordingFailed, match=ITSELF.format(7)):
        own.step(0)


def test_the_frame_of_a_step_that_ends_an_episode_is_not_that_of_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strange_worlds, "AtOnce", AtOnce, raising=False)
    monkeypatch.setattr("recorders.gymnasium_env.environment.import_named", lambda *_: strange_worlds)
    env = _slider(wrappers="strange_worlds:AtOnce")
    for _ in range(5):
        env.step(0)
    with pytest.raises(RecordingFailed, match=ITSELF.format(6)):
        env.step(0)


def test_a_copy_of_a_simulator_is_reset_itself() -> None:
    env: Any = strange_worlds.Slider(render_mode="rgb_array")
    resets = Resets(env)
    env.reset(seed=1)
    again = copy.deepcopy(env)
    again.step(5)
    again.reset(seed=1)
    assert again.reset is not env.reset
    assert (resets.count, again.reset.count) == (1, 2)
    assert (env.render() == again.render()).all()
