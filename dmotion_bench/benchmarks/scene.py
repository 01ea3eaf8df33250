"""A made-up scene: squares of four colours on a plain ground, to measure on where no environment is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

from dmotion_bench.actions import Discrete
from dmotion_bench.specs import DatasetRecipe, EnvSpec, Episode, EpisodeLabels, ObjectSpec, ObjectStates
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

SIZE: Final = 128  # [px]
_SIDE: Final = 20  # of a square [px]
_GROUND: Final = 250
_COLOURS: Final = {"red": (220, 40, 40), "green": (40, 180, 60), "blue": (40, 70, 220), "yellow": (230, 200, 40)}
_AGENT: Final = (30, 30, 30)
_STEP: Final = 4  # of the agent between two frames [px]
_MOVES: Final = np.array([[0, -_STEP], [0, _STEP], [-_STEP, 0], [_STEP, 0]])


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


def scene_dataset(path: Path, episodes: int, frames: int) -> Dataset:
    """Record the scene: the agent walks over it at random, the other squares stay where they are.

    Args:
        path: The data set's folder, which must not be there yet.
        episodes: How many.
        frames: In each.
    """
    recipe = DatasetRecipe(environment="made_up_scene", episodes=episodes, frames=frames)
    with DatasetWriter.create_or_resume(path, recipe, scene_facts()) as writer:
        for shard in writer.missing:
            writer.write_shard(shard, (_walk(number, frames) for number in writer.episodes_of(shard)))
        writer.finish()
    return Dataset.open(path)


def _walk(seed: int, frames: int) -> Episode:
    generator = np.random.default_rng(seed)
    actions = generator.integers(0, len(_MOVES), frames - 1)
    corners = [generator.integers(0, SIZE - _SIDE, 2)]
    for action in actions:
        corners.append(np.clip(corners[-1] + _MOVES[action], 0, SIZE - _SIDE))
    others = generator.integers(0, SIZE - _SIDE, (len(_COLOURS), 2))
    video = np.full((frames, SIZE, SIZE, 3), _GROUND, np.uint8)
    for (x, y), color in zip(others, _COLOURS.values(), strict=True):
        video[:, y : y + _SIDE, x : x + _SIDE] = color
    for picture, (x, y) in zip(video, corners, strict=True):
        picture[y : y + _SIDE, x : x + _SIDE] = _AGENT
    middle = (_SIDE - 1) / 2
    return Episode(
        frames=video,
        labels=EpisodeLabels(
            actions=actions,
            pushed=np.zeros(frames - 1, bool),
            agent=_at(np.stack(corners)[:, None] + middle),
            objects=_at(np.tile(others + middle, (frames, 1, 1))),
            masks=(video == _AGENT).all(axis=-1).astype(np.uint8),
        ),
        seed=seed,
        ended="truncated",
    )


def _at(pixel: Float[np.ndarray, "n objects 2"]) -> ObjectStates:
    count = pixel.shape[:2]
    return ObjectStates(
        position=np.zeros((*count, 3)),
        orientation=np.tile([0.0, 0, 0, 1], (*count, 1)),
        pixel=pixel,
        visible=np.ones(count),
    )
