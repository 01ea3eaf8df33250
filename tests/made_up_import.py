"""Data sets as an import makes them, out of the episodes of another one: no seeds, no objects, no masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dmotion_bench.actions import Discrete, require_discrete
from dmotion_bench.specs import IMPORTED, UNPLACED_AGENT, DatasetRecipe, unplaced_labels
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import Footage
from dmotion_bench.storage.writer import DatasetWriter


def write_import(
    path: Path,
    source: Dataset,
    *,
    actions: Sequence[str] | None = None,
    renamed: Callable[[str], str] = lambda name: name,
    seed: int | None = None,
    picture: Callable[[np.ndarray], np.ndarray] = lambda frames: frames,
    cut: int = 1,
    **facts: Any,
) -> Dataset:
    """An import of all episodes of a data set, in their order.

    Args:
        path: The new data set's folder.
        source: Has the episodes.
        actions: The names of the actions, as the import numbers them; () for video alone. As in the source if None.
        renamed: What an action of the source is called.
        seed: Decides the split; the source's if None.
        picture: What becomes of an episode's frames, an array of t h w 3.
        cut: Into so many equal parts each episode is cut.
        facts: Others of the ``EnvSpec``.
    """
    names = [renamed(name) for name in require_discrete(source.spec.actions, "a made-up import").names]
    given = tuple(names if actions is None else actions)
    numbers = np.array([given.index(name) for name in names]) if given else None
    parts: list[Footage] = []
    for episode in range(len(source)):
        frames, taken = picture(source.video(episode)), source.states(episode).actions
        for steps in np.array_split(np.arange(len(frames)), cut):
            here = frames[steps]
            labels = None if numbers is None else unplaced_labels(numbers[taken[steps[:-1]]], here.shape[:3])
            parts.append(Footage(frames=here, labels=labels))
    height, width = parts[0].frames.shape[1:3]
    recipe = DatasetRecipe(
        environment=IMPORTED,
        parameters={"size": int(width)},
        policy="recorded",
        seed=source.recipe.seed if seed is None else seed,
        episodes=len(parts),
        frames=max(len(part.frames) for part in parts),
    )
    spec = replace(
        source.spec,
        **{
            "id": IMPORTED,
            "actions": Discrete(given) if given else None,
            "agent": UNPLACED_AGENT,
            "objects": (),
            "agent_has_color": False,
        }
        | facts,
        height=height,
        width=width,
    )
    with DatasetWriter.create_or_resume(path, recipe, spec) as writer:
        for shard in writer.missing:
            writer.write_shard(shard, (parts[episode] for episode in writer.episodes_of(shard)))
        writer.finish()
    return Dataset.open(path)
