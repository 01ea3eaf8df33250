"""An entry's figures from samples, and errors summed by episode, which allow comparing entries without samples.

Runs, whose samples are at hand, are compared by ``dmotion_bench/pairing.py``; the two come to the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Int

from dmotion_bench.pairing import compare_runs, scored
from dmotion_bench.scoring.differences import CONTROL_DISTANCES, Difference, better
from dmotion_bench.scoring.figures import PUSH, figures_of
from dmotion_bench.scoring.samples import GAIN, column
from dmotion_bench.scoring.statistics import EARLIER_FEWEST, ROUNDING, Estimate
from dmotion_bench.scoring.trainings import difference_over_trainings, over_trainings

__all__ = [
    "Difference",
    "as_in_an_entry",
    "better",
    "compare_runs",
    "difference_by_episode",
    "figures_by_samples",
    "scored",
    "sums_by_episode",
]

PARTS: Final = ("mean", "std", "low", "high", "n")
"""Of a figure in an entry. The number of its episodes, which a report has, is that of the sums by episode."""

GAIN_CAPTURED: Final = "planning_gain"
"""The figure whose sums an entry may have; those from before 2026-11-29 do not."""

BY_EPISODE: Final = ("mse", "mse_push", "position_error_paper")
"""Figures whose sums stand in an entry. Which frames have a value is a matter of the true frames alone."""


def as_in_an_entry(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """A report's figures with the parts that an entry has."""
    return {name: {part: figure[part] for part in PARTS} for name, figure in figures.items()}


def figures_by_samples(
    samples: pa.Table, predictor: str, said: Mapping[str, Mapping[str, Any]], resamples: int
) -> dict[str, dict[str, Any]]:
    """The figures of samples, to compare an entry's with.

    An interval over fewer episodes than an interval takes today is there only where the entry has one, and that of a
    share that is all alike has no width where the entry's has none: some of the first entries are like that.

    Args:
        samples: Of any predictors.
        predictor: Whose figures.
        said: The entry's figures.
        resamples: Draws for an interval.
    """
    found = figures_of(samples, predictor, resamples=resamples)
    short = [name for name, one in found.items() if one.low is None and said.get(name, {}).get("low") is not None]
    if short:
        earlier = figures_of(samples, predictor, resamples=resamples, fewest=EARLIER_FEWEST)
        found |= {name: earlier[name] for name in short}
    for name, one in found.items():
        given = said.get(name, {})
        low, high = given.get("low"), given.get("high")
        if one.std <= ROUNDING and low is not None and high is not None and high - low <= ROUNDING:
            found[name] = replace(one, low=one.mean, high=one.mean)
    return as_in_an_entry({name: one.to_json() for name, one in found.items()})


def sums_by_episode(samples: pa.Table) -> dict[str, dict[str, list[Any]]]:
    """For some figures, each episode's sum over its samples, and how many they are.

    They are those of ``BY_EPISODE``, and of control the distance at the end, over the tasks of an episode: that of
    positions or, where pictures judge, of pictures. Of the gain captured they are the gains of an episode's moments
    and, in the place of their number, what could be gained at these.
    """
    mine = samples.filter(pc.equal(samples["predictor"], "model"))
    single = mine.filter(pc.equal(mine["metric"], "prediction"))
    found: dict[str, dict[str, list[Any]]] = {}
    if len(single):
        episode, pushed = column(single, "episode"), column(single, "pushed").astype(bool)
        for figure in BY_EPISODE:
            values = column(single, figure.removesuffix(PUSH)).astype(np.float64)
            counted = np.isfinite(values) & (pushed if figure.endswith(PUSH) else True)
            if counted.any():
                found[figure] = _sums(episode[counted], values[counted])
    gained = mine.filter(pc.equal(mine["metric"], GAIN))
    if len(gained):
        gain, best = (column(gained, name).astype(np.float64) for name in ("gain", "best_gain"))
        counted = np.isfinite(gain) & np.isfinite(best) & (best > 0)
        if counted.any():
            found[GAIN_CAPTURED] = _sums(column(gained, "episode")[counted], gain[counted], best[counted])
    for metric, figure in CONTROL_DISTANCES.items():
        controlled = mine.filter(pc.equal(mine["metric"], metric))
        if not len(controlled):
            continue
        last = int(column(controlled, "ahead").max())
        ended = controlled.filter(pc.equal(controlled["ahead"], last))
        distance = column(ended, "control_distance").astype(np.float64)
        found[f"{figure}[{last}]"] = _sums(column(ended, "episode"), distance)
    return found


def _sums(
    episode: Int[np.ndarray, " n"], values: Float[np.ndarray, " n"], wholes: Float[np.ndarray, " n"] | None = None
) -> dict[str, list[Any]]:
    numbers, index = np.unique(episode, return_inverse=True)
    return {
        "episode": numbers.tolist(),
        "n": np.bincount(index, wholes).tolist(),
        "sum": np.bincount(index, values).tolist(),
    }


def difference_by_episode(first: Sequence[Mapping[str, Any]], second: Sequence[Mapping[str, Any]]) -> Estimate | None:
    """The paired difference first - second of two models, each the mean over its trainings, from sums over episodes.

    Its interval is over episodes and, of a model with several trainings, over these. None where the sums are not over
    the same samples.
    """
    count = _count([*first, *second]) if first and second else None
    return None if count is None else difference_over_trainings(_sums_of(first), _sums_of(second), count)


def mean_by_episode(trainings: Sequence[Mapping[str, Any]]) -> Estimate | None:
    """The mean over some trainings of a model, with its 95% interval over episodes and trainings, from such sums.

    None where the sums are not over the same samples.
    """
    count = _count(trainings)
    return None if count is None else over_trainings(_sums_of(trainings), count)


def _count(sums: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, " e"] | None:
    """Samples of each episode, where all sums are over the same ones."""
    if not sums or any((one["episode"], one["n"]) != (sums[0]["episode"], sums[0]["n"]) for one in sums):
        return None
    return np.asarray(sums[0]["n"], np.float64) if sums[0]["n"] else None


def _sums_of(trainings: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, "k e"]:
    return np.asarray([one["sum"] for one in trainings], np.float64)
