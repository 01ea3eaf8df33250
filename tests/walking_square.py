"""A data set that is made in a blink: a square walks over a picture of 32 pixels, a step of four pixels an action."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dmotion_bench.actions import Discrete
from dmotion_bench.specs import DatasetRecipe, EnvSpec, Episode, EpisodeLabels, ObjectSpec, ObjectStates
from dmotion_bench.storage.writer import DatasetWriter

MOVES = np.array([[0, -1], [0, 1], [-1, 0], [1, 0]])
SPEC = EnvSpec(
    id="walk",
    actions=Discrete(("up", "down", "left", "right")),
    agent=ObjectSpec(name="agent", shape="square", color=(250, 250, 250)),
    objects=(),
    height=32,
    width=32,
    agent_has_color=True,
)


def episode(number: int, frames: int = 9) -> Episode:
    """One walk; the square stops at the edge."""
    generator = np.random.default_rng(number)
    actions = generator.integers(0, 4, frames - 1)
    places = [np.array([3, 3])]
    for action in actions:
        places.append(np.clip(places[-1] + MOVES[action], 0, 6))
    pictures = np.full((frames, 32, 32, 3), 60, np.uint8)
    for picture, (x, y) in zip(pictures, places, strict=True):
        picture[4 * y : 4 * y + 8, 4 * x : 4 * x + 8] = 250
    return Episode(
        frames=pictures,
        labels=EpisodeLabels(
            actions=actions,
            pushed=np.zeros(frames - 1, bool),
            agent=_states(frames, 4.0 * np.stack(places)[:, None] + 3.5),
            objects=_states(frames, np.zeros((frames, 0, 2))),
            masks=(pictures[..., 0] == 250).astype(np.uint8),
        ),
        seed=number,
        ended="truncated",
    )


def _states(frames: int, pixel: np.ndarray) -> ObjectStates:
    count = pixel.shape[1]
    return ObjectStates(
        position=np.zeros((frames, count, 3)),
        orientation=np.tile([0.0, 0, 0, 1], (frames, count, 1)),
        pixel=pixel,
        visible=np.ones((frames, count)),
    )


def record_walks(path: Path, episodes: int = 14, frames: int = 9, shard_episodes: int | None = None) -> Path:
    """Write the data set, in one shard unless another size is asked for; returns its folder."""
    recipe = DatasetRecipe(
        environment="walk", episodes=episodes, frames=frames, shard_episodes=shard_episodes or episodes
    )
    with DatasetWriter.create_or_resume(path, recipe, SPEC) as writer:
        for index in writer.missing:
            writer.write_shard(index, [episode(number, frames) for number in writer.episodes_of(index)])
        writer.finish()
    return path
