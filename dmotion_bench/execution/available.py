"""What of this machine is there for more processes: its processors and its free memory, as far as they are granted.

A container, or a job of a cluster, may be granted less than the machine has. Linux says so in the files of its control
groups (version 2; https://docs.kernel.org/admin-guide/cgroup-v2.html), each group within the bounds of those above it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_PROC: Final = Path("/proc")
_GROUPS: Final = Path("/sys/fs/cgroup")


def available_workers(gigabytes: float = 0.0) -> int:
    """How many processes this machine has processors for, and memory that nobody uses, if each takes so much of it."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    granted = (int(own) for group in _groups() if (own := _processors(group)) is not None)
    processors = max(1, min((here, *granted)))
    free = _free_gigabytes() if gigabytes else None
    return processors if free is None else max(1, min(processors, int(free / gigabytes)))


def _free_gigabytes() -> float | None:
    """Memory that could be had without swapping; None where the system does not say."""
    found = [_free_of_machine(), *map(_free_of_group, _groups())]
    return min((bytes_ / 2**30 for bytes_ in found if bytes_ is not None), default=None)


def _groups() -> Iterator[Path]:
    """The folders of the control group of this process, and of those above it."""
    try:
        lines = (_PROC / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        if line.startswith("0::/"):
            own = _GROUPS / line[len("0::/") :]
            yield from (one for one in (own, *own.parents) if one.is_relative_to(_GROUPS))


def _processors(group: Path) -> float | None:
    """How many processors' time a control group is granted; None: all of it."""
    try:
        quota, period = (group / "cpu.max").read_text().split()
        return int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):  # without a bound the quota is "max"
        return None


def _free_of_group(group: Path) -> int | None:
    """Bytes that a control group may still use, with the cached files that it would give back; None: all."""
    try:
        most, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())["inactive_file"]
        return max(0, most - used + int(cached))
    except (OSError, ValueError, KeyError):
        return None


def _free_of_machine() -> int | None:
    try:
        lines = (_PROC / "meminfo").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):
        return None
