"""Made-up episodes for the storage's tests: noise for pictures, noise for labels, no environment."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.specs import DatasetRecipe, EnvSpec, Episode, EpisodeLabels, ObjectSpec, ObjectStates
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

LEFT_RIGHT = Discrete(("left", "right"))
MOVES = Continuous(names=("dx", "turn"), low=(-0.04, 0.0), high=(0.04, 1.5), units=("m", "rad"))


def noise_spec(height: int = 6, width: int = 5, objects: int = 2, actions: ActionSpec = LEFT_RIGHT) -> EnvSpec:
    return EnvSpec(
        id="noise",
        actions=actions,
        agent=ObjectSpec(name="agent", shape="dot", color=(0, 255, 0)),
        objects=tuple(ObjectSpec(name=f"thing {n}", shape="box", color=(n, 0, 0)) for n in range(objects)),
        height=height,
        width=width,
        step_ns=40_000_000,
    )


def noise_states(generator: np.random.Generator, frames: int, count: int) -> ObjectStates:
    """States that hold every kind of number: gone things, zeros, negative zeros, very large ones."""
    position = generator.normal(size=(frames, count, 3))
    position *= _powers_of_ten(generator.integers(-150, 150, (frames, count, 1)))
    position[generator.random((frames, count)) < 0.2] = np.nan
    position[generator.random((frames, count)) < 0.1] = 0.0
    position[generator.random((frames, count)) < 0.1] = -0.0
    return ObjectStates(
        position=position,
        orientation=generator.normal(size=(frames, count, 4)),
        pixel=generator.normal(size=(frames, count, 2)),
        visible=generator.random((frames, count)),
    )


def _powers_of_ten(exponents: np.ndarray) -> np.ndarray:
    """With the same bits on every processor; the last bit of numpy's own powers depends on the processor."""
    return np.vectorize(lambda exponent: float(f"1e{exponent}"), otypes=[float])(exponents)


def noise_actions(generator: np.random.Generator, steps: int, spec: ActionSpec) -> np.ndarray:
    if isinstance(spec, Discrete):
        return generator.integers(0, len(spec), steps)
    actions = spec.denormalise(generator.uniform(-1, 1, (steps, spec.width)))
    actions[generator.random(actions.shape) < 0.2] = 0.0
    return actions


def noise_episode(seed: int, frames: int, spec: EnvSpec) -> Episode:
    generator = np.random.default_rng(seed)
    return Episode(
        frames=generator.integers(0, 256, (frames, spec.height, spec.width, 3), dtype=np.uint8),
        labels=EpisodeLabels(
            actions=noise_actions(generator, frames - 1, spec.actions),
            pushed=generator.random(frames - 1) < 0.5,
            agent=noise_states(generator, frames, 1),
            objects=noise_states(generator, frames, len(spec.objects)),
            masks=generator.integers(0, 4, (frames, spec.height, spec.width), dtype=np.uint8),
            factors={"light": generator.normal(), "name": f"episode {seed}", "count": 3, "on": True},
        ),
        seed=seed,
        ended="terminated" if seed % 2 else "truncated",
    )


def noise_lengths(episodes: int) -> list[int]:
    return [2 + (7 * episode) % 5 for episode in range(episodes)]


def write_noise(
    path: Path,
    episodes: int = 7,
    shard_episodes: int = 3,
    spec: EnvSpec | None = None,
    lengths: list[int] | None = None,
    tasks: int = 0,
) -> Dataset:
    """A complete data set of noise."""
    spec, lengths = spec or noise_spec(), lengths or noise_lengths(episodes)
    recipe = DatasetRecipe(
        environment="noise", episodes=episodes, frames=max(lengths), shard_episodes=shard_episodes, tasks=tasks
    )
    with DatasetWriter.create_or_resume(path, recipe, spec) as writer:
        for index in writer.missing:
            members = writer.episodes_of(index)
            writer.write_shard(index, (noise_episode(one, lengths[one], spec) for one in members))
        writer.finish()
    return Dataset.open(path)


def assert_same_states(left: ObjectStates, right: ObjectStates) -> None:
    for name in ("position", "orientation", "pixel", "visible"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))


def assert_same_labels(left: EpisodeLabels, right: EpisodeLabels) -> None:
    np.testing.assert_array_equal(left.actions, right.actions)
    np.testing.assert_array_equal(left.pushed, right.pushed)
    np.testing.assert_array_equal(left.masks, right.masks)
    assert_same_states(left.agent, right.agent)
    assert_same_states(left.objects, right.objects)
    assert dict(left.factors) == dict(right.factors)


def assert_same_episode(left: Episode, right: Episode) -> None:
    np.testing.assert_array_equal(left.frames, right.frames)
    assert_same_labels(left.labels, right.labels)
    assert (left.seed, left.ended) == (right.seed, right.ended)


def files_of(dataset: Path) -> dict[str, bytes]:
    """Every file of a data set but its cache, by name."""
    return {
        str(file.relative_to(dataset)): file.read_bytes()
        for file in sorted(dataset.rglob("*"))
        if file.is_file() and "cache" not in file.parts
    }
