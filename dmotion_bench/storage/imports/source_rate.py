"""How many pictures a second the recordings of an import have, as its report says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from dmotion_bench.storage.imports.recording import Survey
from dmotion_bench.storage.imports.timeline import GAP_INTERVALS, interval_ns


def source_hz(surveys: Sequence[Survey]) -> float:
    """Pictures a second in all recordings together, without pauses; 0 where no two pictures have different times."""
    every = [segment.times_ns for survey in surveys for segment in survey.segments]
    intervals = np.concatenate([_unbroken_intervals(times_ns) for times_ns in every])
    total = int(intervals.sum())
    return 1e9 * len(intervals) / total if total else 0.0


def source_hz_range(surveys: Sequence[Survey]) -> tuple[float, float]:
    """The lowest and the highest such rate of a recording."""
    rates = [rate for survey in surveys if (rate := source_hz([survey]))]
    return (min(rates), max(rates)) if rates else (0.0, 0.0)


def _unbroken_intervals(times_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " i"]:
    """The times between two pictures where the recording did not pause [ns]."""
    intervals: Int64[np.ndarray, " i"] = np.diff(times_ns)
    usual = interval_ns(times_ns)
    return intervals[intervals <= GAP_INTERVALS * usual] if usual else intervals
