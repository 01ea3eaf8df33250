"""How fast this machine records: what ``dmbench bench`` calls.

It works in a temporary folder, on one process, end to end: what is timed is what a user waits for.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import ShardJob, environment_facts, record_shard
from dmotion_bench.specs import DatasetRecipe, Preset


class RecordedFrames:
    """Called, it simulates, draws, encodes, compresses and syncs one shard, and gives its number of frames.

    Args:
        environment: Registry name.
        recipe: How it is recorded; None for preset small.
    """

    def __init__(self, environment: str, recipe: DatasetRecipe | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="dmbench-")
        recipe = recipe or recipe_for(environment, Preset.SMALL, tasks=0)
        recipe = replace(recipe, episodes=10**6, tasks=0)  # more than will be made
        spec, folder = environment_facts(recipe), Path(self._folder.name)
        self._jobs: Iterator[ShardJob] = (
            ShardJob(dataset=folder, recipe=recipe, spec=spec, index=index) for index in itertools.count()
        )

    def __call__(self) -> float:
        """Record the next shard."""
        return record_shard(next(self._jobs)).frames

    def __enter__(self) -> RecordedFrames:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()
