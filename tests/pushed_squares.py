"""A made-up world for the viewer's tests: an agent walks about, sweeps a red square along, and loses a blue one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.specs import DatasetRecipe, EnvSpec, Episode, EpisodeLabels, ObjectSpec, ObjectStates
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

SIZE, SIDE = 64, 9
SPEC = EnvSpec(
    id="squares",
    actions=Discrete(("up", "down", "left", "right")),
    agent=ObjectSpec(name="green_square", shape="square", color=(0, 200, 0)),
    objects=(
        ObjectSpec(name="red_square", shape="square", color=(230, 30, 30)),
        ObjectSpec(name="blue_square", shape="square", color=(40, 80, 255)),
    ),
    height=SIZE,
    width=SIZE,
    agent_has_color=True,
)
MOVED = replace(SPEC, actions=Continuous(names=("dx", "dy"), low=(-3.0, -3.0), high=(3.0, 3.0), units=("px", "px")))
"""The same with the agent's displacement as its action."""


def squares_episode(seed: int, frames: int = 12, spec: EnvSpec = SPEC) -> Episode:
    """The agent walks at random; the red square is swept along from the middle on, the blue one then vanishes."""
    generator = np.random.default_rng(seed)
    actions = generator.integers(4, size=frames - 1)
    step = np.array([[0, -3], [0, 3], [-3, 0], [3, 0]])[actions]
    agent = np.clip(np.vstack([[32, 32], 32 + np.cumsum(step, axis=0)]), SIDE, SIZE - SIDE)[:, None].astype(float)
    half = frames // 2
    objects = np.tile(np.array([[12.0, 12.0], [50.0, 20.0]]), (frames, 1, 1))
    objects[half:, 0] += agent[half:, 0] - agent[half - 1, 0]
    objects[-2:, 1] = np.nan
    masks = np.zeros((frames, SIZE, SIZE), np.uint8)
    palette = np.zeros((4, 3), np.uint8)
    palette[1], palette[2:] = SPEC.agent.color, [it.color for it in SPEC.objects]
    for frame in range(frames):
        for value, place in ((2, objects[frame, 0]), (3, objects[frame, 1]), (1, agent[frame, 0])):
            if np.isfinite(place).all():
                left, top = np.round(place).astype(int) - SIDE // 2
                rows, columns = (slice(max(0, first), max(0, first + SIDE)) for first in (top, left))
                masks[frame, rows, columns] = value
    moved = np.abs(np.diff(np.nan_to_num(objects, nan=-1), axis=0)).max((1, 2)) > 0
    taken = step.astype(float) if isinstance(spec.actions, Continuous) else actions
    labels = EpisodeLabels(actions=taken, pushed=moved, agent=_states(agent), objects=_states(objects), masks=masks)
    return Episode(frames=palette[masks], labels=labels, seed=seed, ended="truncated")


def _states(pixel: np.ndarray) -> ObjectStates:
    height = np.zeros((*pixel.shape[:2], 1))
    gone = ~np.isfinite(pixel).all(-1)
    return ObjectStates(
        position=np.concatenate([pixel / 100, np.where(gone[..., None], np.nan, height)], axis=-1),
        orientation=np.where(gone[..., None], np.nan, np.array([0.0, 0.0, 0.0, 1.0])),
        pixel=pixel,
        visible=np.where(gone, 0.0, 1.0),
    )


def write_squares(path: Path, episodes: int = 10, frames: int = 8, spec: EnvSpec = SPEC) -> Dataset:
    """A complete data set of squares on disk."""
    recipe = DatasetRecipe(environment="squares", episodes=episodes, frames=frames)
    with DatasetWriter.create_or_resume(path, recipe, spec) as writer:
        for index in writer.missing:
            writer.write_shard(index, (squares_episode(one, frames, spec) for one in writer.episodes_of(index)))
        writer.finish()
    return Dataset.open(path)
