"""When frames were taken -> which frame stands at each tick of a steady clock, in episodes without gaps.

At a tick stands the latest frame that is not later, where a quarter of the camera's usual interval, and half a tick at
most, is forgiven: a 10 Hz camera that jitters by milliseconds, read at 10 Hz, gives each of its frames once.

A long time without a frame ends an episode, since a frame that is repeated over and over looks like a world that
stands still. How long is decided by the camera's own interval and, above that, by the number of repeats.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from dmotion_bench.errors import RecordingImportError

GAP_INTERVALS = 2.5  # of the camera
GAP_TICKS = 1.5  # of the new clock: a shorter gap repeats a frame once at most
MOST_TICKS = 20.0  # of the new clock: a longer gap is no gap of a slow camera, it would be 20 times the same frame
ROUNDED_NS = 2_000  # times this close are one: most rates have no whole interval, and some recorders keep microseconds


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A planned episode: the frames that it shows, and their times.

    Attributes:
        frames: Number of the source frame at each tick, ascending; a frame may stand at several ticks.
        t_ns: The ticks.
    """

    frames: Int64[np.ndarray, " t"]
    t_ns: Int64[np.ndarray, " t"]

    def __len__(self) -> int:
        return len(self.frames)

    def cut(self, start: int, stop: int) -> Piece:
        """Some of its ticks."""
        return Piece(frames=self.frames[start:stop], t_ns=self.t_ns[start:stop])


def interval_ns(times_ns: Int64[np.ndarray, " n"]) -> float:
    """The usual time between two frames: the median, 0 for fewer than two [ns]."""
    return float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 0.0


def steady_hz(times_ns: Int64[np.ndarray, " n"]) -> float:
    """Frames a second while none is lost: over all intervals that are shorter than one and a half usual ones.

    0 for a camera without a steady rate: one such interval in ten is off by more than a quarter.
    """
    intervals, usual = np.diff(times_ns), interval_ns(times_ns)
    whole = intervals[2 * intervals < 3 * usual]
    steady = whole[4 * np.abs(whole - usual) <= usual]
    if not len(steady) or not usual or 10 * len(steady) < 9 * len(whole):
        return 0.0
    return 1e9 * len(whole) / int(whole.sum())


def meant_hz(hz: float) -> float:
    """The whole number that a rate is meant to be, if there is one within half a percent; else four digits."""
    whole = round(hz)
    return float(whole) if abs(hz - whole) <= hz / 200 else float(f"{hz:.4g}")


def longest_gap_ns(usual: float, tick: float) -> float:
    """The longest time without a frame that does not end an episode [ns].

    Two and a half of the camera's usual intervals, at least one and a half ticks and at most twenty.

    Args:
        usual: The camera's usual interval [ns].
        tick: Of the new clock [ns].
    """
    return max(min(GAP_INTERVALS * usual, MOST_TICKS * tick), GAP_TICKS * tick)


def gaps_ns(times_ns: Int64[np.ndarray, " n"], *, hz: float, jumps: Sequence[int] = ()) -> Int64[np.ndarray, " g"]:
    """How long no frame came, each time that ends an episode by default [ns].

    Args:
        times_ns: When each frame was taken, ascending.
        hz: Ticks a second.
        jumps: See ``Segment``.
    """
    intervals = np.diff(times_ns)
    intervals[np.array(jumps, np.int64) - 1] = 0
    gaps: Int64[np.ndarray, " g"] = intervals[intervals > longest_gap_ns(interval_ns(times_ns), 1e9 / hz)]
    return gaps


def forgiven_ns(usual: float, tick: float) -> float:
    """How much later than a tick a frame may be and still stand there [ns]; arguments as for ``longest_gap_ns``."""
    return min(usual / 4, tick / 2)


def irregularity(times_ns: Int64[np.ndarray, " n"]) -> float:
    """How uneven the intervals are: their mean distance from their mean, in units of their mean.

    0 for a steady camera; about 2 where pictures come in bursts. Pauses count as well. Infinite if all have one time.
    """
    intervals = np.diff(times_ns)
    if not len(intervals):
        return 0.0
    mean = float(intervals.mean())
    return float(np.abs(intervals - mean).mean()) / mean if mean else math.inf


def resample(times_ns: Int64[np.ndarray, " n"], *, hz: float, max_gap_s: float | None, most: int) -> list[Piece]:
    """The pieces between gaps, in time order.

    Args:
        times_ns: When each frame was taken, ascending.
        hz: Ticks a second.
        max_gap_s: A longer time without a frame ends a piece [s]; see ``longest_gap_ns`` for the default.
        most: So many ticks may come out.

    Raises:
        RecordingImportError: More would come out.
    """
    usual = interval_ns(times_ns)
    tick = 1e9 / hz
    slack = forgiven_ns(usual, tick)
    gap = longest_gap_ns(usual, tick) if max_gap_s is None else max_gap_s * 1e9
    ends = np.append(np.flatnonzero(np.diff(times_ns) > gap) + 1, len(times_ns))
    pieces: list[Piece] = []
    start = 0
    for end in ends:
        stretch = times_ns[start:end]
        length = float(stretch[-1] - stretch[0])
        ticks = int((length + slack) // tick) + 1
        most -= ticks
        if most < 0:
            raise RecordingImportError(
                f"a recording of {length / 1e9:,.0f} s at {hz:g} Hz is more frames than can be imported at once; "
                "import with a lower '--hz', or fewer files at a time."
            )
        t_ns = stretch[0] + np.rint(np.arange(ticks) * tick).astype(np.int64)
        shown = np.searchsorted(stretch, t_ns + int(slack) + ROUNDED_NS, side="right") - 1
        pieces.append(Piece(frames=start + shown.astype(np.int64), t_ns=t_ns))
        start = int(end)
    return pieces


def cut(pieces: list[Piece], *, longest: int, shortest: int) -> list[Piece]:
    """Pieces of at most ``longest`` ticks; what is shorter than ``shortest`` is left out.

    A piece is cut into parts that differ by one tick at most, so no stub is left over at its end.
    """
    parts: list[Piece] = []
    for piece in pieces:
        edges = np.linspace(0, len(piece), -(-len(piece) // longest) + 1).round().astype(int)
        parts += [piece.cut(a, b) for a, b in itertools.pairwise(edges.tolist()) if b - a >= shortest]
    return parts


def length_for(pieces: list[Piece], *, episodes: int, shortest: int, most: int) -> int | None:
    """The longest episode length, at most ``most``, that cuts the pieces into so many episodes; None without any."""
    pieces = [piece for piece in pieces if len(piece) >= shortest]
    if len(pieces) < episodes:  # k pieces of n ticks in all give at most n / length + k parts
        most = min(most, sum(map(len, pieces)) // (episodes - len(pieces)))
    for longest in range(most, shortest - 1, -1):
        if len(cut(pieces, longest=longest, shortest=shortest)) >= episodes:
            return longest
    return None
