"""A figure of a row: one training's, or the mean over several trainings that differ in their seed alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dmotion_bench.figure_intervals import interval_of
from dmotion_bench.scoring.report import FigureJson
from leaderboard.comparison import mean_by_episode


@dataclass(frozen=True, kw_only=True)
class Value:
    """One figure of one row.

    Attributes:
        mean: Over seeds.
        low, high: The range over several seeds, or one seed's interval over episodes.
        std: Over samples, of a single seed or as published.
        seeds: How many it is the mean of; fewer than the row has where not all were scored on it.
        interval: The 95% interval of the mean: over episodes and, of several seeds, over these; None where it is not
            known.
        samples: That each seed was scored on: frames, or tasks; None where that is not known.
    """

    mean: float
    low: float | None
    high: float | None
    std: float | None
    seeds: int = 1
    interval: tuple[float, float] | None = None
    samples: int | None = None


def values_of(seeds: Sequence[Mapping[str, Any]], sums: Sequence[Mapping[str, Any]] = ()) -> dict[str, Value]:
    """The figures, each as the mean over the seeds that have it; control is often scored for one seed only.

    Args:
        seeds: The figures of each.
        sums: Of each seed the sums over episodes, by figure; of some figures, or of none.
    """
    found: dict[str, Value] = {}
    for name in dict.fromkeys(name for figures in seeds for name in figures):
        own = [figures[name] for figures in seeds if name in figures and figures[name]["mean"] is not None]
        if not own:
            continue
        means = [float(figure["mean"]) for figure in own]
        counts = [figure["n"] for figure in own]
        one = len(own) == 1
        interval = interval_of(name, own[0]) if one else _interval(own, [each[name] for each in sums if name in each])
        low, high = (interval or (None, None)) if one else (min(means), max(means))
        found[name] = Value(
            mean=sum(means) / len(means),
            low=low,
            high=high,
            std=own[0]["std"] if one else None,
            seeds=len(own),
            interval=interval,
            samples=None if None in counts else int(max(counts)),
        )
    return found


def _interval(figures: Sequence[FigureJson], sums: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """The interval of a figure of several seeds, from their sums over episodes."""
    mean = mean_by_episode(sums) if len(sums) == len(figures) else None
    return None if mean is None or mean.low is None or mean.high is None else (mean.low, mean.high)
