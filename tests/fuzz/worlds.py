"""Tiny data sets that the other originals are made of: noise of 16 pixels, with everything that a data set can hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.specs import DatasetRecipe, EnvSpec, Episode, EpisodeLabels, ObjectSpec, ObjectStates
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

NAMED = Discrete(("left", "right", "up"))
MOVES = Continuous(names=("dx", "turn"), low=(-0.04, 0.0), high=(0.04, 1.5), units=("m", "rad"))
SPEC = EnvSpec(
    id="noise",
    actions=NAMED,
    agent=ObjectSpec(name="agent", shape="dot", color=(0, 255, 0)),
    objects=(
        ObjectSpec(name="one", shape="box", color=(255, 0, 0)),
        ObjectSpec(name="two", shape="box", color=(0, 0, 255)),
    ),
    height=16,
    width=16,
    step_ns=40_000_000,
    agent_has_color=True,
)
EPISODES = 12
FRAMES = 6


def write_noise(path: Path, actions: ActionSpec = NAMED) -> Dataset:
    """A data set with labels, factors and control tasks, whose environment is not installed."""
    recipe = DatasetRecipe(
        environment="noise",
        policy="random",
        episodes=EPISODES,
        frames=FRAMES,
        tasks=4,
        shard_episodes=5,
    )
    with DatasetWriter.create_or_resume(path, recipe, replace(SPEC, actions=actions)) as writer:
        for index in writer.missing:
            writer.write_shard(index, (_episode(number, actions) for number in writer.episodes_of(index)))
        writer.finish()
    return Dataset.open(path)


def record_grid_world(path: Path, episodes: int = 3, frames: int = 5) -> Dataset:
    """A data set whose environment is there, so that lost shards can be recorded anew."""
    from recorders.grid_things import FACTS
    from recorders.grid_world import GridWorld

    recipe = DatasetRecipe(
        environment="grid_world", policy="random", seed=3, episodes=episodes, frames=frames, shard_episodes=2
    )
    with DatasetWriter.create_or_resume(path, recipe, FACTS) as writer:
        for index in writer.missing:
            writer.write_shard(index, record_episodes(GridWorld, recipe, writer.episodes_of(index)))
        writer.finish()
    return Dataset.open(path)


def _episode(number: int, actions: ActionSpec) -> Episode:
    rng = np.random.default_rng(number)
    frames = FRAMES - number % 2
    return Episode(
        frames=rng.integers(0, 256, (frames, SPEC.height, SPEC.width, 3), dtype=np.uint8),
        labels=EpisodeLabels(
            actions=_actions(rng, frames - 1, actions),
            pushed=rng.random(frames - 1) < 0.6,
            agent=_states(rng, frames, 1),
            objects=_states(rng, frames, 2),
            masks=rng.integers(0, 4, (frames, SPEC.height, SPEC.width), dtype=np.uint8),
            factors={"light": 0.5, "name": f"episode {number}", "count": 3, "on": True} if number < 6 else {},
        ),
        seed=number,
        ended="terminated" if number % 2 else "truncated",
    )


def _actions(rng: np.random.Generator, steps: int, actions: ActionSpec) -> np.ndarray:
    if isinstance(actions, Continuous):
        return actions.denormalise(rng.uniform(-1, 1, (steps, actions.width)))
    return rng.integers(0, len(actions), steps)


def _states(rng: np.random.Generator, frames: int, count: int) -> ObjectStates:
    return ObjectStates(
        position=rng.normal(size=(frames, count, 3)),
        orientation=rng.normal(size=(frames, count, 4)),
        pixel=rng.uniform(0, 15, (frames, count, 2)),
        visible=rng.random((frames, count)),
    )
