"""Figures of several trainings of a model, with 95% intervals over episodes and trainings.

A two-level bootstrap: each draw takes whole episodes and, independently, trainings of each model. Two or three
trainings are few, so what the drawn ones lie apart is widened (``widening``): as a factor where nothing is below zero,
as of errors and distances, so that an interval does not reach below zero either, and as a difference elsewhere. Of a
model with a single training an interval is about that training alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri, stdtrit

from dmotion_bench.scoring.statistics import FEWEST_EPISODES, LEVEL, RESAMPLES, SEED, Estimate, draws, expanded_tail

DETECTED: Final = 0.8
"""How often a difference of the smallest detectable size is shown."""


def over_trainings(
    sums: Float[np.ndarray, "k e"], counts: Float[np.ndarray, " e"], *, resamples: int = RESAMPLES
) -> Estimate:
    """The mean of several trainings of a model, with an interval over episodes and trainings.

    Of one training the interval is over episodes alone. Over fewer than ``FEWEST_EPISODES`` episodes there is none.

    Args:
        sums: Of each training, each episode's sum over its samples.
        counts: Each episode's number of samples.
        resamples: How many draws.
    """
    low = high = None
    if len(counts) >= FEWEST_EPISODES:
        low, high = _bounds(_drawn(sums, counts, widening(sums, counts), resamples), len(counts))
    return _estimate(sums.mean(axis=0), counts, low, high)


def difference_over_trainings(
    first: Float[np.ndarray, "k e"],
    second: Float[np.ndarray, "l e"],
    counts: Float[np.ndarray, " e"],
    *,
    resamples: int = RESAMPLES,
) -> Estimate:
    """How much lower the mean of ``second`` is than that of ``first`` on the same samples: first - second, paired.

    Both models are drawn on the same episodes, and each with trainings of its own. Student's t has Welch's degrees of
    freedom (1947), since the two models' trainings may differ by unequal amounts. Over fewer than
    ``FEWEST_EPISODES`` episodes there is no interval.

    Args:
        first, second: As ``over_trainings`` takes ``sums``; each model has as many trainings as it has.
        counts, resamples: Likewise.
    """
    low = high = None
    if len(counts) >= FEWEST_EPISODES:
        freedom = _freedom([between(own, counts) / len(own) for own in (first, second)], [len(first), len(second)])
        one, other = (
            _drawn(own, counts, widening(own, counts, freedom), resamples, *which)
            for own, which in ((first, ()), (second, (1,)))
        )
        low, high = _bounds(one - other, len(counts))
    return _estimate(first.mean(axis=0) - second.mean(axis=0), counts, low, high)


def _drawn(
    sums: Float[np.ndarray, "k e"], counts: Float[np.ndarray, " e"], wider: float, resamples: int, *which: int
) -> Float[np.ndarray, " r"]:
    """The mean of each draw: of the episodes that all models share, and of trainings by which model it is."""
    trainings, episodes = sums.shape
    drawn = draws(episodes, resamples)
    means = drawn @ sums.T / (drawn @ counts)[:, None]
    middle: Float[np.ndarray, " r"] = means.mean(axis=1)
    if trainings > 1:
        generator = np.random.default_rng([SEED, episodes, trainings, *which])
        share = generator.multinomial(trainings, np.full(trainings, 1 / trainings), size=resamples) / trainings
        found = (share * means).sum(axis=1)
        middle = as_factor(found, middle, wider) if (sums >= 0).all() else middle + wider * (found - middle)
    return middle


def as_factor(drawn: Float[np.ndarray, " r"], middle: Float[np.ndarray, " r"], wider: float) -> Float[np.ndarray, " r"]:
    """Drawn means of trainings, whose distance from the mean of all is widened as a factor.

    Args:
        drawn, middle: Nowhere negative.
        wider: See ``widening``.
    """
    ratio = np.divide(drawn, middle, out=np.ones_like(drawn), where=middle > 0)
    widened: Float[np.ndarray, " r"] = middle * ratio**wider
    return widened


def _bounds(drawn: Float[np.ndarray, " r"], episodes: int) -> tuple[float, float]:
    tail = expanded_tail(episodes)
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return float(low), float(high)


def _estimate(
    sums: Float[np.ndarray, " e"], counts: Float[np.ndarray, " e"], low: float | None, high: float | None
) -> Estimate:
    return Estimate(
        mean=float(sums.sum() / counts.sum()),
        std=float((sums / counts).std()),
        low=low,
        high=high,
        n=int(counts.sum()),
        episodes=len(counts),
    )


def widening(sums: Float[np.ndarray, "k e"], counts: Float[np.ndarray, " e"], freedom: float | None = None) -> float:
    """By what the distance of drawn trainings' mean from that of all is multiplied; 1 for a single training.

    It is widened for the small number of trainings as the quantiles are for that of episodes: by sqrt(k / (k - 1)) and
    by Student's t instead of the normal. And it is scaled to what trainings truly differ by: means over the same
    episodes also differ because each training does some of them better by chance, which the draws of episodes hold
    already.

    Args:
        sums, counts: As ``over_trainings`` takes them.
        freedom: Degrees of freedom of Student's t; one less than there are trainings if left out.
    """
    trainings = len(sums)
    if trainings < 2:
        return 1.0
    spread = float((sums.sum(axis=1) / counts.sum()).var(ddof=1))
    quantile = float(stdtrit(freedom or trainings - 1, (1 + LEVEL) / 2) / ndtri((1 + LEVEL) / 2))
    true = math.sqrt(between(sums, counts) / spread) if spread else 0.0
    return math.sqrt(trainings / (trainings - 1)) * quantile * true


def _freedom(variances: list[float], trainings: list[int]) -> float | None:
    """Welch's degrees of freedom of a sum of means with these variances; None where no trainings differ."""
    parts = [(own, count - 1) for own, count in zip(variances, trainings, strict=True) if count > 1 and own > 0]
    total = sum(own for own, _ in parts)
    return total**2 / sum(own**2 / freedom for own, freedom in parts) if parts else None


def detectable_difference(
    pairs: Iterable[tuple[Float[np.ndarray, "k e"], Float[np.ndarray, "l e"], Float[np.ndarray, " e"]]],
) -> float | None:
    """The true difference between two models that their interval would show in ``DETECTED`` of all cases.

    It is found from pairs of models as they were measured: a difference is shown where it exceeds half the width of
    the pair's interval. With a few trainings these widths differ much from pair to pair, so the share of cases is the
    mean over the pairs. What a measured difference is off by is taken for normal, with the standard error that all
    pairs have together.

    Args:
        pairs: As ``difference_over_trainings`` takes them.

    Returns:
        None where no pair has an interval, or nothing differs.
    """
    halves, variances = [], []
    for first, second, counts in pairs:
        found = difference_over_trainings(first, second, counts)
        if found.low is not None and found.high is not None:
            halves.append((found.high - found.low) / 2)
            variances.append(standard_error(first, second, counts) ** 2)
    error = math.sqrt(np.mean(variances)) if variances else 0.0
    if not error:
        return None
    low, high = 0.0, max(halves) + float(ndtri(DETECTED)) * error
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        shown = float(ndtr((middle - np.array(halves)) / error).mean())
        low, high = (low, middle) if shown >= DETECTED else (middle, high)
    return high


_HALVINGS: Final = 50


def standard_error(
    first: Float[np.ndarray, "k e"], second: Float[np.ndarray, "l e"], counts: Float[np.ndarray, " e"]
) -> float:
    """Of the paired difference of two models: over episodes and, of a model with several trainings, over these.

    Args:
        first, second: As ``over_trainings`` takes ``sums``.
        counts: Likewise.
    """
    samples, episodes = counts.sum(), len(counts)
    apart = first.mean(axis=0) - second.mean(axis=0)
    off = apart - apart.sum() / samples * counts
    variance = np.square(off).sum() / samples**2 * episodes / (episodes - 1)
    for own in (first, second):
        if len(own) > 1:
            variance += between(own, counts) / len(own)
    return float(np.sqrt(variance))


def between(sums: Float[np.ndarray, "k e"], counts: Float[np.ndarray, " e"]) -> float:
    """The variance of what trainings come to on ever more episodes: that of their means, less the part of chance.

    That part comes from what is left of each episode's sum without the training's and the episode's own level. It is
    zero of a single training.
    """
    trainings, episodes = sums.shape
    if trainings < 2:
        return 0.0
    samples = counts.sum()
    each = sums.sum(axis=1) / samples
    off = sums - sums.mean(axis=0) - (each - each.mean())[:, None] * counts
    chance = np.square(off).sum() / (trainings - 1) * episodes / (episodes - 1) / samples**2
    return float(max(0.0, each.var(ddof=1) - chance))
