"""How many threads compute: part of what decides a training's bits, for other numbers of threads add in another order.

So a run is scored, too, with the number that it was trained with.

The same number gives the same bits however many cores there are (measured, docs/decisions); with fewer cores than
threads it takes several times as long.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import torch

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.hardware.precision import FEWEST_STEPS


@contextlib.contextmanager
def using_threads(count: int | None) -> Iterator[None]:
    """Compute with so many threads within the block; None leaves their number as it is.

    Raises:
        UsageError: The environment does not allow so many.
    """
    if count is None:
        yield
        return
    if (told := not_allowed(count)) is not None:
        raise UsageError(told)
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


def not_allowed(count: int) -> str | None:
    """Why so many threads cannot be had here; None if they can."""
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    if not limit.isdecimal() or int(limit) >= count:
        return None
    return (
        f"the run computes with {count} threads, and OMP_THREAD_LIMIT allows {limit}; unset that variable, or "
        f"begin another run with '--threads {limit} --out DIR'."
    )


def shortage(threads: int, cores: int, processes: int = 1) -> str | None:
    """A warning for a training with more threads than there are cores; None if there are enough.

    Args:
        threads: Of each process.
        cores: Of this machine that may be used.
        processes: Of this machine that train together.
    """
    few = _few(threads, cores, processes)
    if few is None:
        return None
    fewer = max(1, cores // processes)
    begin = f"; '--threads {fewer} --out DIR' begins another run." if fewer < threads else "."
    return f"{few} It goes on so, which gives the same weights and takes several times as long{begin}"


def scoring_shortage(threads: int, cores: int) -> str | None:
    """A warning for the scoring of a run with more threads than there are cores; None if there are enough."""
    few = _few(threads, cores)
    return few and f"{few} It is scored with {threads}, which gives the same figures and takes several times as long."


def _few(threads: int, cores: int, processes: int = 1) -> str | None:
    if threads * processes <= cores:
        return None
    many = "1 thread" if threads == 1 else f"{threads} threads"
    each = f"{processes} processes of {many} each" if processes > 1 else many
    free = "1 core is" if cores == 1 else f"{cores} cores are"
    return f"this run computes with {each}, and {free} free here."
