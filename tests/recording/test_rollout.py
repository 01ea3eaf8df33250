"""What an environment of one's own draws and tells is held against its facts while it is recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import RecordingFailed
from dmotion_bench.recording.rollout import record_episode
from recorders.grid_world import GridWorld


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
