"""Random numbers that depend on the training step alone, so that resuming needs no saved generator."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import torch


@contextlib.contextmanager
def seeded(seed: int, step: int, device: torch.device, rank: int = 0) -> Iterator[None]:
    """Seed the random numbers within the block by (seed, step); restore the generators afterwards.

    Processes that share a batch draw different numbers, by their rank; the first draws those of a single process.
    """
    with torch.random.fork_rng([device.index or 0] if device.type == "cuda" else []):
        source = np.random.SeedSequence([seed, step], spawn_key=(rank,) if rank else ())
        torch.manual_seed(int(source.generate_state(1, np.uint64)[0] >> 1))
        yield
