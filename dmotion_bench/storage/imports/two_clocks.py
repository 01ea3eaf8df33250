"""The two times of a picture: when it was recorded, and when the camera says that it took it.

A recorder's clock may be set while it records, as a robot's is when it finds a time server. The pictures' own time
stamps go on then, so the difference of the two clocks stays the same before and after, and is another one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int64

from dmotion_bench.storage.imports.timeline import irregularity
from dmotion_bench.wording import duration

UNEVEN: Final = 0.5  # of intervals: jitter is less, pauses and bursts are more
MOST_APART: Final = 1.0  # [s] from a picture to its recording: camera and network take less, other clocks differ more
_FEWEST: Final = 3  # pictures after which a difference is one that lasts
_SHOWN: Final = 3  # jumps in a sentence
Times = Int64[np.ndarray, " n"]


@dataclass(frozen=True, kw_only=True)
class Jump:
    """A moment at which a recorder's clock was set forward.

    Attributes:
        picture: The number of the first picture after it.
        by_ns: How far.
    """

    picture: int
    by_ns: int


def jumps(recorded_ns: Times, stamps_ns: Times) -> list[Jump]:
    """Where the recorder's clock was set forward; none where the pictures' own time stamps cannot tell.

    Args:
        recorded_ns, stamps_ns: Of each picture.
    """
    if not is_ascending(stamps_ns):
        return []
    between = itertools.pairwise(_levels(recorded_ns - stamps_ns))
    steps = [Jump(picture=after.start, by_ns=after.apart_ns - before.apart_ns) for before, after in between]
    return [jump for jump in steps if jump.by_ns > MOST_APART * 1e9]


def is_ascending(times_ns: Times) -> bool:
    """Whether each time is later than the one before: stamps that are missing are all alike."""
    return bool((np.diff(times_ns) > 0).all())


def apart_s(recorded_ns: Times, stamps_ns: Times) -> float | None:
    """By how much a camera's time stamps are of another clock than the recorder's [s]; None: they are of the same.

    So far apart are most pictures, or those before or after a jump of one of the clocks.

    Args:
        recorded_ns, stamps_ns: Of each picture.
    """
    apart_ns = recorded_ns - stamps_ns
    usual = [float(np.median(apart_ns)), *(float(level.apart_ns) for level in _levels(apart_ns))]
    return next((apart / 1e9 for apart in usual if abs(apart) > MOST_APART * 1e9), None)


def delay_ns(recorded_ns: Times, stamps_ns: Times) -> int:
    """How much later than they were taken most pictures were recorded [ns].

    0 where the time stamps are missing, or of another clock, or later than the recording.

    Args:
        recorded_ns, stamps_ns: Of each picture.
    """
    if not is_ascending(stamps_ns) or apart_s(recorded_ns, stamps_ns) is not None:
        return 0
    return max(0, int(np.median(recorded_ns - stamps_ns)))


def told_of_jumps(file: Path, found: Sequence[Jump]) -> str:
    """What is told of jumps, without its full stop.

    Args:
        file: In which they are.
        found: At least one.
    """
    places = [f"by {duration(jump.by_ns / 1e9)} after picture {jump.picture:,}" for jump in found[:_SHOWN]]
    more = f" and at {len(found) - _SHOWN:,} more places" if len(found) > _SHOWN else ""
    jumped = f"the recorder's clock jumped forward {', '.join(places)}{more}"
    return f"{str(file)!r}: {jumped}, while the camera's own time stamps go on"


def is_steadier(one_ns: Times, other_ns: Times) -> bool:
    """Whether one clock's times are uneven and the other's are much less so."""
    uneven = irregularity(one_ns)
    return uneven >= UNEVEN and uneven >= 2 * irregularity(other_ns)


@dataclass(frozen=True, kw_only=True)
class _Level:
    """Pictures that follow each other and whose two times are equally far apart."""

    start: int
    apart_ns: int


def _levels(apart_ns: Times) -> list[_Level]:
    """The stretches between jumps of the difference, where that is constant but for a few jumps; else none.

    Pictures that were recorded in bursts are no such case: their difference shrinks between its jumps.

    Args:
        apart_ns: The difference of each picture's two times.
    """
    steps = np.abs(np.diff(apart_ns))
    if not len(steps) or steps.max() <= MOST_APART * 1e9:
        return []
    edges = np.flatnonzero(steps > max(MOST_APART * 1e9, steps.max() / 10)) + 1
    bounds = itertools.pairwise([0, *edges.tolist(), len(apart_ns)])
    lasting = [(start, apart_ns[start:end]) for start, end in bounds if end - start >= _FEWEST]
    if len(lasting) < 2 or 10 * sum(len(level) for _, level in lasting) < 9 * len(apart_ns):
        return []
    if 2 * max(int(np.ptp(level)) for _, level in lasting) > steps[edges - 1].min():
        return []
    return [_Level(start=start, apart_ns=int(np.median(level))) for start, level in lasting]
