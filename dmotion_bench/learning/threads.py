"""How many threads compute: part of what decides a training's bits, for other numbers of threads add in another order.

The same number gives the same bits however many cores there are (measured, docs/decisions); with fewer cores than
threads it takes several times as long.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import torch

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.precision import FEWEST_STEPS


@contextlib.contextmanager
def using_threads(count: int) -> Iterator[None]:
    """Compute with so many threads within the block.

    Raises:
        UsageError: The environment does not allow so many.
    """
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    if limit.isdecimal() and int(limit) < count:
        raise UsageError(
            f"the run computes with {count} threads, and OMP_THREAD_LIMIT allows {limit}; unset that variable, or "
            f"begin another run with '--threads {limit} --out DIR'."
        )
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def has_choice_of_threads(steps: int, device: torch.device, processes: int) -> bool:
    """Whether a training that no number of threads is asked for may measure which number is faster.

    Not where it is short, and not where somebody has set the number of threads for torch.
    """
    own = "OMP_NUM_THREADS" not in os.environ and processes == 1 and device.type == "cpu"
    return own and steps >= FEWEST_STEPS and torch.get_num_threads() > 1


def shortage(threads: int, cores: int) -> str | None:
    """A warning for a run with more threads than there are cores; None if there are enough."""
    if threads <= cores:
        return None
    free = "1 core is" if cores == 1 else f"{cores} cores are"
    return (
        f"this run computes with {threads} threads, and {free} free here. It goes on with {threads}, which gives the "
        f"same weights and takes several times as long; '--threads {cores} --out DIR' begins another run."
    )
