"""A made-up scene: squares of four colours on a plain ground, to measure on where no environment is needed."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import UInt8

from dmotion_bench.actions import Discrete
from dmotion_bench.specs import EnvSpec, ObjectSpec

SIZE: Final = 128  # [px]
_SIDE: Final = 20  # of a square [px]
_GROUND: Final = 250
_COLOURS: Final = {"red": (220, 40, 40), "green": (40, 180, 60), "blue": (40, 70, 220), "yellow": (230, 200, 40)}
_AGENT: Final = (30, 30, 30)


def scene_facts() -> EnvSpec:
    """What the planner and the position finder know of the scene."""
    return EnvSpec(
        id="made_up_scene",
        actions=Discrete(("up", "down", "left", "right")),
        agent=ObjectSpec(name="agent", shape="square", color=_AGENT),
        objects=tuple(ObjectSpec(name=name, shape="square", color=color) for name, color in _COLOURS.items()),
        height=SIZE,
        width=SIZE,
        agent_has_color=True,
    )


def scene_frames(count: int, seed: int = 0) -> UInt8[np.ndarray, "n h w 3"]:
    """Pictures of the scene, the squares at random places."""
    generator = np.random.default_rng(seed)
    frames = np.full((count, SIZE, SIZE, 3), _GROUND, np.uint8)
    for frame in frames:
        for color in (*_COLOURS.values(), _AGENT):
            row, column = generator.integers(0, SIZE - _SIDE, 2)
            frame[row : row + _SIDE, column : column + _SIDE] = color
    return frames
