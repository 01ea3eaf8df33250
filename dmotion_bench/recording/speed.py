"""How fast this machine records and reads: plain functions that ``dmbench bench`` calls.

Each works in a temporary folder, on one process, end to end: what is timed is what a user waits for. Seconds of
the processor stand beside those of the clock, because a busy machine stretches the latter only.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import ShardJob, environment_facts, record_dataset, record_shard
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class Speed:
    """So many frames in so much time.

    Attributes:
        frames: How many.
        seconds: By the clock.
        cpu_seconds: Of this process, in user and system mode.
        bytes: Written or read, compressed.
    """

    frames: int
    seconds: float
    cpu_seconds: float
    bytes: int

    @property
    def frames_per_s(self) -> float:
        """Frames per second of elapsed time."""
        return self.frames / self.seconds

    @property
    def frames_per_cpu_s(self) -> float:
        """Frames per second of processor time, which other programs do not disturb."""
        return self.frames / self.cpu_seconds

    @property
    def bytes_per_frame(self) -> float:
        """Video and labels together."""
        return self.bytes / self.frames


def measure_recording(environment: str, seconds: float = 5.0) -> Speed:
    """Simulate, draw, encode, compress and sync shards of the environment for so long, on one core."""
    with _folder() as folder:
        recipe = _recipe(environment)
        spec = environment_facts(recipe)
        jobs = (ShardJob(dataset=folder, recipe=recipe, spec=spec, index=index) for index in itertools.count())
        record_shard(next(jobs))  # imports and tables that are made once
        frames = size = 0
        watch = _Stopwatch()
        while frames == 0 or watch.seconds < seconds:
            receipt = record_shard(next(jobs))
            frames += receipt.frames
            size += receipt.video.size + (receipt.labels.size if receipt.labels else 0)
        return watch.speed(frames, size)


def measure_reading(environment: str, seconds: float = 5.0) -> Speed:
    """Read episodes' video, one seek each, for so long, on one core."""
    with _dataset(environment) as dataset:
        return _repeat(dataset, seconds, lambda: [dataset.video(number).size for number in range(len(dataset))])


def measure_cache(environment: str, seconds: float = 5.0) -> Speed:
    """Make the frame cache, again and again for so long, on one core."""

    def make() -> None:
        dataset.cache_file.build(dataset.video(number) for number in range(len(dataset)))

    with _dataset(environment) as dataset:
        return _repeat(dataset, seconds, make)


def _repeat(dataset: Dataset, seconds: float, work: Callable[[], object]) -> Speed:
    frames, watch = 0, _Stopwatch()
    while frames == 0 or watch.seconds < seconds:
        work()
        frames += int(dataset.lengths.sum())
    passes = frames // int(dataset.lengths.sum())
    return watch.speed(frames, passes * sum(shard.video.size for shard in dataset.manifest.shards))


def _recipe(environment: str) -> DatasetRecipe:
    """The usual shards, and more of them than will be made."""
    return replace(recipe_for(environment, Preset.SMALL, tasks=0), episodes=10**6)


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="dmbench-") as name:
        yield Path(name)


@contextmanager
def _dataset(environment: str) -> Iterator[Dataset]:
    with _folder() as folder:
        record_dataset(folder / "data", replace(_recipe(environment), episodes=20))
        yield Dataset.open(folder / "data")


class _Stopwatch:
    """Runs from its making on."""

    def __init__(self) -> None:
        self._start, self._cpu_start = time.perf_counter(), time.process_time()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._start

    def speed(self, frames: int, size: int) -> Speed:
        return Speed(frames=frames, seconds=self.seconds, cpu_seconds=time.process_time() - self._cpu_start, bytes=size)
