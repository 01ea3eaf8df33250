"""Differences of two models in the figures of a report, paired: on the same frames, tasks and moments.

Most of the spread of an error is that of the frames, which are the same for both models; in the difference it
cancels. The interval is a bootstrap over episodes and, of a model with several trainings, over these
(``trainings.py``). "Better" is said only where it lies on one side of zero. Of a single training it speaks of this
trained model, not of other seeds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Shaped

from dmotion_bench.scoring.figures import PUSH, ROLLOUT_COLUMNS, SHARES, base_of, is_solved
from dmotion_bench.scoring.samples import (
    CONTROL,
    FIGURE_COLUMNS,
    GAIN,
    IDENTIFICATION_COLUMNS,
    PICTURE_CONTROL,
    RANK_COLUMNS,
    column,
)
from dmotion_bench.scoring.statistics import Estimate
from dmotion_bench.scoring.trainings import difference_over_trainings

HIGHER_IS_BETTER: Final = frozenset(
    {
        "psnr",
        "ssim",
        "agent_iou",
        "motion_probe_accuracy",
        "inverse_accuracy",
        "hit_at_1",
        "reciprocal_rank",
        "control_success",
        "planning_gain",
        "state_probe",
    }
)
NEITHER_IS_BETTER: Final = frozenset({"motion_swap_change"})
Better = Literal["first", "second"]
Standing = Literal["behind", "tie", "unknown"]
PAIRED: Final = ("prediction", "rollout", GAIN, CONTROL, PICTURE_CONTROL)
"""The metrics of samples, in the order of their figures."""
_KEY: Final = ("episode", "step", "ahead")
_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    CONTROL: ("task", "ahead"),
    PICTURE_CONTROL: ("task", "ahead"),
    GAIN: (*_KEY, "best_gain"),  # two stretches of an episode may have their moments at one frame, with other goals
}
"""Of samples that ``_KEY`` does not name."""

CONTROL_DISTANCES: Final[Mapping[str, str]] = {
    CONTROL: "control_distance",
    PICTURE_CONTROL: "control_picture_distance",
}
"""By the metric of samples of control, the figure of their distances; at the start all are 1 away."""

_SOLVED: Final = "control_success"
"""A share of tasks."""
_ENDED: Final = (_SOLVED, "control_lost")
"""Figures of control at its end."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The difference of two models in one figure.

    Attributes:
        figure: By its fixed name.
        first, second: The means over the samples that both have.
        difference: Of first - second.
    """

    figure: str
    first: float
    second: float
    difference: Estimate

    @property
    def better(self) -> Better | None:
        """Which of the two models is better; None if the interval contains zero."""
        return better(self.figure, self.difference.low, self.difference.high)

    @property
    def verdict(self) -> str:
        """Which is better, or why that is not said: they are tied, or too few episodes have no interval."""
        return self.better or (_unknown(self.difference) if standing(self.difference) == "unknown" else "tied")


def better(figure: str, low: float | None, high: float | None) -> Better | None:
    """Which of two models is better, by the interval of first - second; None if the interval contains zero."""
    if low is None or high is None or low <= 0 <= high:
        return None
    base = base_of(figure)
    if base in NEITHER_IS_BETTER:
        return None
    return "first" if (low > 0) == (base in HIGHER_IS_BETTER) else "second"


def behind(samples: pa.Table, best: pa.Table) -> Estimate | None:
    """The paired difference of the MSE one step ahead from the best; None if the runs share no sample."""
    tables = _aligned([_single_steps(of_model(table)) for table in (samples, best)], _KEY)
    if not len(tables[0]):
        return None
    values = np.stack([_values(table, "mse") for table in tables])
    found = _difference("mse", values, np.ones(values.shape[1]), column(tables[0], "episode"), 1)
    return None if found is None else found.difference


def standing(difference: Estimate) -> Standing:
    """Whether a run with this difference is behind the best or tied with it; unknown with too few episodes."""
    if difference.low is None or difference.high is None:
        return "unknown"
    return "tie" if difference.low <= 0 <= difference.high else "behind"


def standing_words(difference: Estimate, above: str, between: str) -> str:
    """A run's standing in words; ``above`` is its difference from the best as text, ``between`` the interval."""
    words = {"behind": f"{above} ({between})", "tie": f"tied ({between})", "unknown": _unknown(difference)}
    return words[standing(difference)]


def _unknown(difference: Estimate) -> str:
    """That a difference without an interval says nothing, and of how few episodes it is."""
    count = difference.episodes
    return "unknown" if count is None else f"unknown: {'one episode' if count == 1 else f'{count} episodes'}"


def _single_steps(samples: pa.Table) -> pa.Table:
    return samples.filter(pc.equal(samples["metric"], "prediction"))


def of_model(samples: pa.Table) -> pa.Table:
    return samples.filter(pc.equal(samples["predictor"], "model"))


def differences(first: Sequence[pa.Table], second: Sequence[pa.Table]) -> Iterator[Difference]:
    """Of the samples of each training of two models."""
    for metric in PAIRED:
        chosen = [samples.filter(pc.equal(samples["metric"], metric)) for samples in (*first, *second)]
        tables = _aligned(chosen, _KEYS.get(metric, _KEY))
        one = tables[0]
        if not len(one):
            continue
        episode, ahead = column(one, "episode"), column(one, "ahead")
        pushed = np.nan_to_num(column(one, "pushed").astype(np.float64)).astype(bool)
        everything = np.ones(len(one), bool)
        steps = np.unique(ahead).tolist()
        parts: list[tuple[str, str, Any]] = []
        if metric == GAIN:
            parts += [("planning_gain", "gain", everything)]
        elif metric == "prediction":
            parts += [(name, name, everything) for name in FIGURE_COLUMNS]
            parts += [(name + PUSH, name, pushed) for name in FIGURE_COLUMNS if name not in IDENTIFICATION_COLUMNS]
        elif metric in CONTROL_DISTANCES:
            name = CONTROL_DISTANCES[metric]
            parts += [(f"{name}[{step}]", "control_distance", ahead == step) for step in steps if step > 0]
            parts += [(name, name, ahead == ahead.max()) for name in _ENDED if metric == CONTROL]
        else:
            alike = all(len(table) == len(one) for table in chosen)  # a rank is among the rollouts of its own scoring
            names = [name for name in ROLLOUT_COLUMNS if alike or name not in RANK_COLUMNS]
            parts += [(f"rollout_{name}[{step}]", name, ahead == step) for name in names for step in steps]
        wholes = _values(one, "best_gain") if metric == GAIN else everything.astype(np.float64)
        for figure, name, rows in parts:
            values = np.stack([_values(table, name)[rows] for table in tables])
            found = _difference(figure, values, wholes[rows], episode[rows], len(first))
            if found is not None:
                yield found


def _difference(
    figure: str,
    values: Float[np.ndarray, "t n"],
    wholes: Float[np.ndarray, " n"],
    episodes: Shaped[np.ndarray, " n"],
    trainings: int,
) -> Difference | None:
    """The difference of a figure on the samples that all have.

    Args:
        figure: Its fixed name.
        values: Of each training, the first model's before the second's; the figure is their sum / that of ``wholes``.
        wholes: Ones for a mean.
        episodes: Of each sample.
        trainings: Of the first model.
    """
    counted = np.isfinite(values).all(axis=0) & np.isfinite(wholes) & (wholes > 0)
    if not counted.any():
        return None
    values, wholes = values[:, counted], wholes[counted]
    numbers, place = np.unique(episodes[counted], return_inverse=True)
    sums = np.stack([np.bincount(place, own, len(numbers)) for own in values])
    estimate = difference_over_trainings(sums[:trainings], sums[trainings:], np.bincount(place, wholes, len(numbers)))
    apart = (values[:trainings].mean(axis=0) - values[trainings:].mean(axis=0)) / wholes
    first, second = (float(own.mean(axis=0).sum() / wholes.sum()) for own in (values[:trainings], values[trainings:]))
    estimate = replace(estimate, std=float(apart.std()), n=int(counted.sum()))
    estimate = estimate.within(-1, 1) if base_of(figure) in SHARES else estimate
    return Difference(figure=figure, first=first, second=second, difference=estimate)


def _values(samples: pa.Table, name: str) -> Float[np.ndarray, " n"]:
    if name == _SOLVED:
        return is_solved(column(samples, "control_distance"))
    return column(samples, name).astype(np.float64)


def _aligned(tables: Sequence[pa.Table], key: Sequence[str]) -> list[pa.Table]:
    """The rows that all have, in the same order."""
    if not all(map(len, tables)):
        return [table.slice(0, 0) for table in tables]
    places = [_places(np.stack([column(table, name) for name in key], axis=1)) for table in tables]
    common = [key for key in places[0] if all(key in other for other in places[1:])]
    return [
        table.take(pa.array([own[key] for key in common], pa.int64()))
        for table, own in zip(tables, places, strict=True)
    ]


def _places(keys: Shaped[np.ndarray, "n k"]) -> dict[tuple[float, ...], int]:
    """The row of each key; the last number of a key says how many rows before had the same."""
    met, found = Counter[tuple[float, ...]](), dict[tuple[float, ...], int]()
    for place, key in enumerate(map(tuple, keys.tolist())):
        found[*key, met[key]] = place
        met[key] += 1
    return found
