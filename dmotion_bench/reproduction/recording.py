"""A data set of a table: where it is, how it is recorded, and whether it is there."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from dmotion_bench.errors import DatasetError, DatasetMissing
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import environment_facts
from dmotion_bench.reproduction.table import World
from dmotion_bench.specs import DatasetRecipe, EnvSpec, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.shard import shard_count
from dmotion_bench.storage.writer import check_recipe

ELSEWHERE: Final = "rename that folder, or name another workspace with DMBENCH_WORKSPACE"
"""What to do where a folder of the table holds something else."""


@dataclass(frozen=True)
class Recording:
    """A data set of a table.

    Attributes:
        world: What is recorded.
        preset: Its size.
        folder: Where.
    """

    world: World
    preset: Preset
    folder: Path

    @cached_property
    def recipe(self) -> DatasetRecipe:
        """How it is recorded."""
        world = self.world
        return recipe_for(
            world.environment,
            self.preset,
            episodes=world.episodes,
            frames=world.frames,
            tasks=world.tasks,
            seed=world.seed,
            vary=world.vary,
            policy=world.policy,
            settings=world.settings,
        )

    @cached_property
    def facts(self) -> EnvSpec:
        """What is true of its environment."""
        return environment_facts(self.recipe)

    def dataset(self) -> Dataset | None:
        """The data set, once all of it is recorded."""
        with contextlib.suppress(DatasetError):
            dataset = Dataset.open(self.folder)
            if len(dataset) >= self.recipe.episodes:
                return dataset
        return None

    def is_recorded(self) -> bool:
        """Whether the data set is there, as the table has it."""
        dataset = self.dataset()
        return dataset is not None and dataset.recipe == self.recipe

    def require_own(self) -> None:
        """See that the folder holds this data set, a part of it, or none.

        Raises:
            RecipeMismatch: It holds another one.
            DatasetError: What it holds cannot be read.
        """
        if self.is_recorded():
            return
        with contextlib.suppress(DatasetMissing):
            check_recipe(Manifest.read(self.folder), self.recipe, self.facts, self.folder, ELSEWHERE)

    def few(self, episodes: int) -> DatasetRecipe:
        """A recipe of so few episodes, to try something on."""
        return replace(self.recipe, episodes=min(episodes, self.recipe.episodes), tasks=1)

    def shards_left(self) -> int:
        """How many shards are still to be made."""
        if self.dataset() is not None:
            return 0
        return shard_count(self.recipe) - len(list(self.folder.glob("video/*.mcap")))
