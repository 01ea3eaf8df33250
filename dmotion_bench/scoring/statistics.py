"""Figures from samples: mean, standard deviation over samples, and a 95% interval over episodes.

The steps of one episode are alike, so an interval over samples would be far too narrow. Whole episodes are drawn
anew instead (a cluster bootstrap): each draw gives the figure of its pooled samples, a ratio of sums over
episodes, and the interval is read from the draws' quantiles. With few episodes plain quantiles lie too close
together; they are widened as Hesterberg proposes (2015, "What teachers should know about the bootstrap", section
4.4: expanded percentile intervals), by Student's t instead of the normal and n - 1 instead of n.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from scipy.special import ndtr, stdtrit

LEVEL = 0.95
RESAMPLES = 2000


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One figure of a report.

    Attributes:
        mean: Over all samples.
        std: Over samples, the population's.
        low, high: Bounds of the 95% interval over episodes; None where fewer than two episodes have a sample.
        n: Number of samples.
    """

    mean: float
    std: float
    low: float | None
    high: float | None
    n: int

    def to_json(self) -> dict[str, Any]:
        """As it stands in a report."""
        return {"mean": self.mean, "std": self.std, "low": self.low, "high": self.high, "n": self.n}


class EpisodeBootstrap:
    """The bootstrap over episodes; figures with the same number of episodes share their draws.

    Args:
        episodes: Of each sample.
        resamples: Number of draws.
        seed: Of the draws.
    """

    def __init__(self, episodes: Shaped[np.ndarray, " n"], *, resamples: int = RESAMPLES, seed: int = 0) -> None:
        self._clusters, self._cluster = np.unique(episodes, return_inverse=True)
        self._resamples, self._seed = resamples, seed

    def mean(self, values: Float[np.ndarray, " n"]) -> Estimate | None:
        """The mean of samples; NaN ones are left out. None if there are no others."""
        counted = np.isfinite(values)
        samples = values[counted].astype(np.float64)
        if not len(samples):
            return None
        totals = self.totals(np.stack([np.where(counted, values, 0.0), counted], axis=1))
        low, high = self.interval(totals, lambda sums: sums[:, 0] / sums[:, 1])
        return Estimate(mean=float(samples.mean()), std=float(samples.std()), low=low, high=high, n=len(samples))

    def ratio(self, parts: Float[np.ndarray, " n"], wholes: Float[np.ndarray, " n"]) -> Estimate | None:
        """The sum of some parts divided by the sum of their wholes; its std is that of each part's own share.

        Samples of which either is NaN, and wholes that are not above zero, are left out; None if none are left.
        """
        counted = np.isfinite(parts) & np.isfinite(wholes) & (wholes > 0)
        if not counted.any():
            return None
        totals = self.totals(np.stack([np.where(counted, one, 0.0) for one in (parts, wholes)], axis=1))
        low, high = self.interval(totals, lambda sums: sums[:, 0] / sums[:, 1])
        shares = parts[counted] / wholes[counted]
        mean = float(parts[counted].sum() / wholes[counted].sum())
        return Estimate(mean=mean, std=float(shares.std()), low=low, high=high, n=len(shares))

    def totals(self, values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "e m"]:
        """Sums over each episode's samples."""
        columns = values.astype(np.float64).T
        return np.stack([np.bincount(self._cluster, column, len(self._clusters)) for column in columns], axis=1)

    def interval(
        self,
        totals: Float[np.ndarray, "e m"],
        statistic: Callable[[Float[np.ndarray, "r m"]], Float[np.ndarray, " r"]],
    ) -> tuple[float, float] | tuple[None, None]:
        """The interval of a statistic of sums over episodes.

        Args:
            totals: Sums of each episode; episodes whose sums are all zero have no say.
            statistic: From the sums of ``r`` draws to the figure of each; NaN where a draw has none.
        """
        present = totals[(totals != 0).any(axis=1)]
        if len(present) < 2:
            return None, None
        with np.errstate(divide="ignore", invalid="ignore"):
            drawn = statistic(_draws(len(present), self._resamples, self._seed) @ present)
        drawn = drawn[np.isfinite(drawn)]
        if not len(drawn):
            return None, None
        tail = expanded_tail(len(present))
        low, high = np.quantile(drawn, [tail, 1 - tail])
        return float(low), float(high)


def paired_difference(
    first: Float[np.ndarray, " n"],
    second: Float[np.ndarray, " n"],
    episodes: Shaped[np.ndarray, " n"],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate | None:
    """How much lower ``second`` is than ``first`` on the same samples: the mean of first - second.

    Samples that either lacks (NaN) are left out; None if none are left.
    """
    return EpisodeBootstrap(episodes, resamples=resamples, seed=seed).mean(first - second)


def expanded_tail(clusters: int, level: float = LEVEL) -> float:
    """Which quantile of the draws bounds the interval: (1 - level) / 2, made smaller for few clusters."""
    quantile = float(stdtrit(clusters - 1, (1 + level) / 2))
    return float(ndtr(-math.sqrt(clusters / (clusters - 1)) * quantile))


@lru_cache(maxsize=4)
def _draws(episodes: int, resamples: int, seed: int) -> Float[np.ndarray, "r e"]:
    """The number of times that each draw contains each episode."""
    generator = np.random.default_rng([seed, episodes])
    return generator.multinomial(episodes, np.full(episodes, 1 / episodes), size=resamples).astype(np.float64)
