"""What an environment of one's own draws and tells is held against its facts while it is recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import RecordingFailed
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.specs import ObjectStates
from recorders.grid_world import GridWorld
from recorders.planar_push.environment import PlanarPush


def left(env: Any, generator: np.random.Generator) -> int:
    return 0


def drawing(picture: Any, after: int) -> Any:
    """The environment, which draws something else after so many steps."""

    class Odd(GridWorld):
        taken = 0

        def reset(self, **options: Any) -> Any:
            frame, info = super().reset(**options)
            return (picture(frame) if after == 0 else frame), info

        def step(self, action: int) -> Any:
            self.taken += 1
            frame, *rest = super().step(action)
            return (picture(frame) if self.taken == after else frame), *rest

    return Odd()


@pytest.mark.parametrize("after", [0, 2])
@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (lambda frame: frame / 255, "draws float64 of"),
        (lambda frame: frame[:, ::2], "draws uint8 of"),
        (lambda frame: frame[..., 0], "draws uint8 of"),
        (lambda frame: None, "draws NoneType; by its facts a picture is a uint8 array of"),
    ],
)
def test_a_picture_that_its_facts_do_not_know_is_refused(picture: Any, said: str, after: int) -> None:
    with pytest.raises(RecordingFailed, match=said):
        record_episode(drawing(picture, after), left, 0, 5)


def test_more_objects_than_its_facts_name_are_refused() -> None:
    env: Any = GridWorld()
    env.facts = replace(env.facts, objects=())
    with pytest.raises(RecordingFailed, match=r"tells where \d objects are; its facts name 0"):
        record_episode(env, left, 0, 5)


def test_arrays_that_an_environment_or_a_policy_uses_again_are_copied() -> None:
    class Reusing(PlanarPush):
        """Its states are views, as MuJoCo's are, and it writes into the actions that it is given."""

        def objects(self) -> ObjectStates:
            told = super().objects()
            self.kept = getattr(self, "kept", told)
            self.kept.position[:] = told.position
            return self.kept

        def step(self, action: Any) -> Any:
            outcome = super().step(np.array(action))
            action *= 0
            return outcome

    class Again:
        def __init__(self, *, new: bool) -> None:
            self.action, self.new = np.zeros(2), new

        def __call__(self, env: Any, generator: np.random.Generator) -> Any:
            self.action = np.zeros(2) if self.new else self.action
            self.action[:] = generator.uniform(-0.02, 0.02, 2)
            return self.action

    labels = record_episode(Reusing(actions="continuous"), Again(new=False), 3, 8).labels
    plain = record_episode(PlanarPush(actions="continuous"), Again(new=True), 3, 8).labels
    np.testing.assert_array_equal(labels.actions, plain.actions)
    np.testing.assert_array_equal(labels.objects.position, plain.objects.position)


@pytest.mark.parametrize(
    ("method", "told", "said"),
    [
        ("masks", lambda masks: masks / 2, r"masks that are float64 of \(128, 128\)"),
        ("masks", lambda masks: masks[:1], r"masks that are uint8 of \(1, 128\)"),
        ("masks", lambda masks: masks * 20, r"masks with values from 0 to \d+; by its facts they are 0 to 5"),
        ("agent", lambda agent: None, "a NoneType as the states of its agents"),
        ("objects", lambda objects: replace(objects, position=objects.position[:, :2]), r"array of \(4, 2\)"),
        ("objects", lambda objects: replace(objects, visible=1.0), r"'visible' of its objects as an array of \(\)"),
        (
            "objects",
            lambda objects: replace(objects, pixel=objects.pixel.astype(str)),
            "'pixel' of its objects as an arr",
        ),
        ("reset", lambda outcome: (outcome[0], None), "tells None in 'reset' beside the frame; that and its 'factors'"),
        ("reset", lambda outcome: (outcome[0], {"factors": [1]}), r"tells \[1\] in 'reset' beside the frame"),
        ("reset", lambda outcome: (outcome[0], {"factors": {"light": np.ones(2)}}), "a ndarray as its factor 'light'"),
        ("reset", lambda outcome: (outcome[0], {"factors": {1: 2.0}}), "tells a factor of the name 1; a name is to be"),
        ("step", lambda outcome: outcome[:4], "raised ValueError in 'step' at step 0 of the episode with seed 0: not"),
        ("step", lambda outcome: 1 / 0, r"division by zero \(test_rollout.py, line \d+\)"),
        ("reset", lambda outcome: outcome[0], "raised ValueError in 'reset'"),
    ],
)
def test_what_its_facts_do_not_know_is_refused(
    method: str, told: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = getattr(GridWorld, method)
    monkeypatch.setattr(GridWorld, method, lambda env, *given, **named: told(usual(env, *given, **named)))
    with pytest.raises(RecordingFailed, match=said):
        record_episode(GridWorld(), left, 0, 5)
