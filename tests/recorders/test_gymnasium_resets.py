"""A simulator that begins a new episode by itself would have its first frame recorded as what an action led to."""

from __future__ import annotations

import copy
import enum
from typing import Any

import gymnasium
import numpy as np
import pytest
import strange_worlds
from strange_worlds import SLIDER

from dmotion_bench.errors import RecordingFailed
from dmotion_bench.registry import environment_class
from recorders.gymnasium_env.resets import Resets, is_first

strange_worlds.register()
AUTORESET = "gymnasium.wrappers:Autoreset"
ITSELF = "began a new episode by itself at step {} of the episode with seed 3, so the next frame would not be what"


class AtOnce(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Is reset within the step that ends an episode."""

    def step(self, action: Any) -> Any:
        told = super().step(action)
        if told[2] or told[3]:
            self.env.reset()
        return told


class Unending(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Says nothing of an end, and begins anew."""

    def step(self, action: Any) -> Any:
        observed, gained, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            self.env.reset()
        return observed, gained, False, False, info


class StepType(enum.IntEnum):
    """As that of dm_env."""

    FIRST = 0
    MID = 1
    LAST = 2

    def first(self) -> bool:
        return self is StepType.FIRST

    def mid(self) -> bool:
        return self is StepType.MID

    def last(self) -> bool:
        return self is StepType.LAST


class OfDmEnv(strange_worlds.Slider):
    """As shimmy makes one of a simulator of dm_env, which begins anew in the step after its last, and is not reset."""

    limit = 6

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.restart = False
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        if self.restart:
            self.restart, self.place, self.taken = False, 1, []
            return self.observed(), 0, False, False, {"timestep.step_type": StepType.FIRST}
        observed, gained, _, _, _ = super().step(action)
        self.restart = len(self.taken) == self.limit
        kind = StepType.LAST if self.restart else StepType.MID
        return observed, gained, False, self.restart, {"timestep.discount": 1.0, "timestep.step_type": kind}


def _slider(**parameters: Any) -> Any:
    env: Any = environment_class(SLIDER)(frame_size=24, places=48, max_episode_steps=6, **parameters)
    env.reset(seed=3)
    return env


def test_within_skipped_frames_a_new_episode_is_refused_and_a_time_limit_is_not() -> None:
    plain, own = _slider(action_repeat=4), _slider(action_repeat=4, wrappers=AUTORESET)
    for env in (plain, own):
        assert env.step(0)[3] is False
    assert plain.step(0)[3] is True
    with pytest.raises(RecordingFailed, match=ITSELF.format(7) + ".*Autoreset'.*fewer '--frames' or a"):
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


def test_who_says_nothing_of_an_end_and_begins_anew_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strange_worlds, "Unending", Unending, raising=False)
    monkeypatch.setattr("recorders.gymnasium_env.environment.import_named", lambda *_: strange_worlds)
    env = _slider(wrappers="strange_worlds:Unending")
    for _ in range(5):
        env.step(0)
    with pytest.raises(RecordingFailed, match=ITSELF.format(6)):
        env.step(0)


@pytest.mark.parametrize("repeat", [1, 4])
def test_a_simulator_of_dm_env_that_begins_anew_is_refused(repeat: int) -> None:
    if (name := "Strange/OfDmEnv-v0") not in gymnasium.registry:
        gymnasium.register(id=name, entry_point=OfDmEnv)
    env: Any = environment_class(f"gym:{name}")(frame_size=24, places=48, action_repeat=repeat)
    env.reset(seed=3)
    ended = [env.step(1)[3] for _ in range(6 // repeat)]
    assert ended == [False] * 5 + [True] if repeat == 1 else [False]
    with pytest.raises(RecordingFailed, match=ITSELF.format(7)):
        env.step(1)
    env.reset(seed=3)
    env.step(1)


class Shy:
    """Raises whatever it is asked."""

    @property
    def first(self) -> Any:
        raise RuntimeError


@pytest.mark.parametrize(
    ("info", "first"),
    [
        ({"step": StepType.FIRST}, True),
        ({"step": StepType.MID}, False),
        ({"step": StepType.LAST}, False),
        ({"first": True, "is_first": np.True_}, False),
        ({"shy": Shy()}, False),
        (None, False),
    ],
)
def test_only_dm_env_s_word_for_the_first_step_is_taken(info: Any, first: bool) -> None:
    assert is_first(info) is first
