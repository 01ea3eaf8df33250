"""Memory that streaming takes for few and for many episodes: ``python -m dmotion_bench.benchmarks.streaming_memory``.

Each number of episodes is recorded into a folder of its own and streamed by a process of its own, whose peak resident
set is told: at the start, with the data set open, and after an epoch. The made-up scene is recorded, so that nothing of
an environment is in memory.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import torch

from dmotion_bench.benchmarks.scene import scene_dataset
from dmotion_bench.learning.data.streamed import StreamedBatches, StreamedTriplets
from dmotion_bench.storage.dataset import Dataset

_BATCH: Final = 32
_UNIT: Final = 2**10 if sys.platform == "darwin" else 1  # what getrusage counts in [KiB], or bytes on a Mac


@dataclass(frozen=True, kw_only=True)
class Memory:
    """The peak resident set of a process that streams, in MiB.

    Attributes:
        episodes: Of the data set.
        triplets: That were streamed.
        before: With everything imported.
        opened: With the data set open.
        streamed: After so many triplets.
    """

    episodes: int
    triplets: int
    before: float
    opened: float
    streamed: float


def measure_memory(path: Path, window: int, most: int) -> Memory:
    """Stream an epoch, or as many triplets as asked for, in the present process."""
    before = _peak()
    dataset = Dataset.open(path)
    opened = _peak()
    triplets = StreamedTriplets.of_split(dataset, "train", window=window)
    order = triplets.order(_BATCH, seed=0)
    batches = StreamedBatches(triplets, order, None, torch.device("cpu"))
    steps = min(order.steps(1), -(-most // _BATCH))
    try:
        for step in range(steps):
            batches.expect(step, 0, 1)
            batches.gather(order.batch(step))
    finally:
        batches.close()
    return Memory(episodes=len(dataset), triplets=steps * _BATCH, before=before, opened=opened, streamed=_peak())


def _peak() -> float:
    import resource  # Windows has none, and imports every module all the same

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _UNIT / 2**10


def _into(queue: Any, *given: Any) -> None:
    queue.put(measure_memory(*given))


def main(words: Sequence[str] | None = None) -> None:
    """Record, stream and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--window", type=int, default=2048)
    parser.add_argument("--most", type=int, default=10**9, help="triplets that are streamed at most")
    asked = parser.parse_args(words)
    context = multiprocessing.get_context("spawn")
    for episodes in asked.episodes:
        with tempfile.TemporaryDirectory(prefix="dmbench-") as folder:
            scene_dataset(Path(folder) / "scene", episodes, asked.frames)
            queue = context.Queue()
            process = context.Process(target=_into, args=(queue, Path(folder) / "scene", asked.window, asked.most))
            process.start()
            found = queue.get(timeout=3600)
            process.join()
        sys.stdout.write(json.dumps(asdict(found)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
