"""Whether a manifest can be true: its counts against the limits, against each other, and against the files' sizes.

One place decides what is accepted, whoever says it: a recording or import that is about to begin, or a
``dataset.json`` from anybody.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Final

from dmotion_bench.specs import IMPORTED, DatasetRecipe, EnvSpec, ObjectSpec
from dmotion_bench.storage.limits import (
    INDEX_BYTES,
    LARGEST_FILE,
    LARGEST_SIDE,
    LAST_NS,
    LONGEST_NAME,
    LONGEST_TEXT,
    MOST_EPISODES,
    MOST_FACTORS,
    MOST_FRAMES,
    MOST_OBJECTS,
    MOST_PARAMETERS,
    MOST_REPLAYED,
    MOST_SHARD_EPISODES,
    MOST_TASKS,
    MOST_VERSIONS,
    longest_episode,
    most_frames,
)
from dmotion_bench.storage.shard import PAUSE_FRAMES, shard_count, shard_range
from dmotion_bench.wording import VALUE_LIMIT, shortened, shown

if TYPE_CHECKING:
    from dmotion_bench.storage.manifest import Manifest, ShardEntry

_HASH: Final = re.compile(r"[0-9a-f]{64}")


def check_manifest(manifest: Manifest, tables: Collection[str]) -> None:
    """See that a manifest can be true.

    Args:
        manifest: The manifest.
        tables: The names of a complete data set's tables.

    Raises:
        ValueError: It cannot; says what is wrong, to follow "cannot be read: ".
    """
    check_spec(manifest.spec)
    check_recipe(manifest.recipe, manifest.spec)
    if manifest.replay is not None:
        _check_count("the replayed episodes", len(manifest.replay.episodes), 1, MOST_REPLAYED)
        for episode in manifest.replay.episodes:
            _check_count("a replayed episode", episode, 0, manifest.recipe.episodes - 1)
        _check_texts("replay.differs", [manifest.replay.differs], LONGEST_TEXT)
    _check_count("versions", len(manifest.versions), 0, MOST_VERSIONS)
    _check_texts("versions", [*manifest.versions, *manifest.versions.values()], LONGEST_NAME)
    if set(manifest.tables) != (set(tables) if manifest.complete else set()):
        raise ValueError(f"it lists the tables {shown(sorted(manifest.tables))}")
    for name, facts in manifest.tables.items():
        _check_file(name, *facts)
    expected = shard_count(manifest.recipe) if manifest.complete else 0
    if len(manifest.shards) != expected:
        raise ValueError(f"it lists {len(manifest.shards):,} shards; its recipe makes {expected:,}")
    for index, shard in enumerate(manifest.shards):
        _check_shard(index, shard, manifest)
    if len({shard.labels is None for shard in manifest.shards}) > 1:
        raise ValueError("some of its shards have labels and some have none")


def check_spec(spec: EnvSpec) -> None:
    """See that an environment's facts can be true.

    Raises:
        ValueError: They cannot.
    """
    _check_texts("environment.id", [spec.id], LONGEST_NAME)
    _check_count("environment.objects", len(spec.objects), 0, MOST_OBJECTS)
    _check_count("environment.other_agents", len(spec.other_agents), 0, MOST_OBJECTS - len(spec.objects))
    for thing in (*spec.agents, *spec.objects):
        _check_thing(thing)
    if len({thing.name for thing in spec.objects}) != len(spec.objects):
        raise ValueError("two of the objects have the same name")
    if spec.other_agents and len({thing.name for thing in (*spec.agents, *spec.objects)}) != (
        len(spec.agents) + len(spec.objects)
    ):
        raise ValueError("two of the agents and objects have the same name")
    _check_count("environment.height", spec.height, 1, LARGEST_SIDE)
    _check_count("environment.width", spec.width, 1, LARGEST_SIDE)
    _check_count("environment.step_ns", spec.step_ns, 1, LAST_NS)
    if not (math.isfinite(spec.push_threshold) and spec.push_threshold >= 0):
        raise ValueError(f"environment.push_threshold is {spec.push_threshold}; it is a distance in metres")


def check_recipe(recipe: DatasetRecipe, spec: EnvSpec) -> None:
    """See that a recipe can be carried out with these facts.

    Raises:
        ValueError: It cannot.
    """
    _check_count("recipe.seed", recipe.seed, 0, 2**64)
    _check_count("recipe.episodes", recipe.episodes, 1, MOST_EPISODES)
    _check_count("recipe.frames", recipe.frames, 1, MOST_FRAMES)
    _check_count("recipe.tasks", recipe.tasks, 0, MOST_TASKS)
    _check_count("recipe.shard_episodes", recipe.shard_episodes, 1, MOST_SHARD_EPISODES)
    _check_count("recipe.vary", len(recipe.vary), 0, MOST_FACTORS)
    _check_count("recipe.parameters", len(recipe.parameters), 0, MOST_PARAMETERS)
    _check_texts("recipe", [recipe.environment, recipe.policy, *recipe.vary, *recipe.parameters], LONGEST_NAME)
    _check_texts(
        "recipe.parameters", [value for value in recipe.parameters.values() if isinstance(value, str)], LONGEST_TEXT
    )
    if any(isinstance(value, float) and not math.isfinite(value) for value in recipe.parameters.values()):
        raise ValueError("a parameter of the recipe is not finite")
    lasts_ns = recipe.episodes * (recipe.frames + PAUSE_FRAMES) * spec.step_ns
    if recipe.environment != IMPORTED and lasts_ns > LAST_NS:
        raise ValueError(
            f"recipe.episodes ({recipe.episodes:,}) of recipe.frames ({recipe.frames:,}) last longer than the "
            f"{LAST_NS / 1e9 / 86400 / 365:.0f} years that a time stamp can count"
        )


def check_episode_size(recipe: DatasetRecipe, spec: EnvSpec) -> None:
    """See that the longest episode of a recipe fits into memory.

    Raises:
        ValueError: It does not.
    """
    if recipe.frames > most_frames(spec):
        raise ValueError(f"recipe.frames is {recipe.frames:,}; {longest_episode(spec)}")


def _check_shard(index: int, shard: ShardEntry, manifest: Manifest) -> None:
    wanted = len(shard_range(manifest.recipe, index))
    if shard.episodes != wanted:
        raise ValueError(f"shard {index} has {shard.episodes:,} episodes; the recipe puts {wanted:,} into it")
    _check_count(f"the frames of shard {index}", shard.frames, shard.episodes, shard.episodes * manifest.recipe.frames)
    _check_file(f"the video of shard {index}", *shard.video)
    if shard.labels is not None:
        _check_file(f"the labels of shard {index}", *shard.labels)
    if shard.frames * INDEX_BYTES > shard.video.size:
        raise ValueError(f"shard {index} has {shard.frames:,} frames in a file of {shard.video.size:,} bytes")


def _check_file(name: str, size: int, sha256: str) -> None:
    _check_count(f"the size of {name}", size, 1, LARGEST_FILE)
    if not _HASH.fullmatch(sha256):
        raise ValueError(f"the hash of {name} is {shown(sha256)}")


def _check_thing(thing: ObjectSpec) -> None:
    _check_texts("the names of the agent and the objects", [thing.name, thing.shape], LONGEST_NAME)
    if len(thing.color) != 3 or not all(0 <= part <= 255 for part in thing.color):
        raise ValueError(f"a colour is {shown(thing.color)}")


def _check_count(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} is {shortened(f'{value:,}', VALUE_LIMIT)}; it can be {low:,} to {high:,}")


def _check_texts(name: str, texts: Iterable[str], longest: int) -> None:
    for text in texts:
        if len(text) > longest:
            raise ValueError(f"{name} holds {shown(text)}, which is longer than {longest:,} characters")
        try:
            text.encode()
        except UnicodeEncodeError:
            raise ValueError(f"{name} holds {shown(text)}, which is not UTF-8 text") from None
