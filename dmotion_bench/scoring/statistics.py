"""Figures from samples: mean, standard deviation over samples, and a 95% interval over episodes.

The steps of one episode are alike, so an interval over samples would be far too narrow. Whole episodes are drawn
anew instead (a cluster bootstrap): each draw gives the figure of its pooled samples, a ratio of sums over
episodes, and the interval is read from the draws' quantiles. With few episodes plain quantiles lie too close
together; they are widened as Hesterberg proposes (2015, "What teachers should know about the bootstrap", section
4.4: expanded percentile intervals), by Student's t instead of the normal and n - 1 instead of n. Of fewer than
``FEWEST_EPISODES`` no widening helps, because there are too few different draws: such a figure has no interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.special import ndtr, ndtri, stdtrit

LEVEL = 0.95
RESAMPLES = 2000
SEED: Final = 0
"""Of every draw: the same samples have the same interval."""

FEWEST_PAIRS: Final = 8
"""That a correlation takes. In simulations an interval over five pairs holds the truth in 77 to 95% of the cases."""

FEWEST_EPISODES: Final = 5
"""That an interval takes. In simulations intervals over 2, 3 and 4 hold the truth in 52, 77 and 86% of the cases."""

EARLIER_FEWEST: Final = 2
"""As many it took when the first results were published; some of these have intervals over fewer than today."""

ROUNDING: Final = 1e-12
"""A standard deviation of shares, or a width of an interval, below this is rounding: all cases, or draws, are alike."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One figure of a report.

    Attributes:
        mean: Over all samples.
        std: Over samples, the population's; of several trainings over episodes, of a correlation over the draws.
        low, high: Bounds of the 95% interval over episodes; None where fewer than ``FEWEST_EPISODES`` episodes have a
            sample.
        n: Number of samples; of a gain captured by several trainings what could be gained, which counts nothing.
        episodes: Number of episodes that have a sample; None where that is not known.
    """

    mean: float
    std: float
    low: float | None
    high: float | None
    n: int
    episodes: int | None = None

    def within(self, least: float, most: float) -> Estimate:
        """The same of a figure whose samples all lie between two bounds, as those of a share lie between 0 and 1.

        Where all samples are alike, no draw of them differs. The upper end of Wilson's interval for none of as many
        cases as there are episodes then bounds the share of other cases, each of which may be anything between the
        bounds. Of a share that is 0 or 1 this is Wilson's interval.
        """
        if self.low is None or self.high is None or not self.episodes:
            return self
        _, others = (0.0, 0.0) if self.std > ROUNDING else wilson(0.0, self.episodes)
        low, high = (self.mean + others * (bound - self.mean) for bound in (least, most))
        return replace(self, low=max(least, min(low, self.low)), high=min(most, max(high, self.high)))

    def to_json(self) -> dict[str, Any]:
        """As it stands in a report."""
        figure = {"mean": self.mean, "std": self.std, "low": self.low, "high": self.high, "n": self.n}
        return figure if self.episodes is None else figure | {"episodes": self.episodes}


class EpisodeBootstrap:
    """The bootstrap over episodes; figures with the same number of episodes share their draws.

    Args:
        episodes: Of each sample.
        resamples: Number of draws.
        fewest: Episodes that an interval takes.
    """

    def __init__(
        self, episodes: Shaped[np.ndarray, " n"], *, resamples: int = RESAMPLES, fewest: int = FEWEST_EPISODES
    ) -> None:
        self._clusters, self._cluster = np.unique(episodes, return_inverse=True)
        self._resamples, self._fewest = resamples, fewest

    def mean(self, values: Float[np.ndarray, " n"]) -> Estimate | None:
        """The mean of samples; those that are NaN or infinite are left out. None if there are no others."""
        counted = np.isfinite(values)
        samples = values[counted].astype(np.float64)
        if not len(samples):
            return None
        totals = self.totals(np.stack([np.where(counted, values, 0.0), counted], axis=1))
        low, high = self.interval(totals, lambda sums: sums[:, 0] / sums[:, 1])
        return Estimate(
            mean=float(samples.mean()),
            std=float(samples.std()),
            low=low,
            high=high,
            n=len(samples),
            episodes=self.present(counted),
        )

    def ratio(self, parts: Float[np.ndarray, " n"], wholes: Float[np.ndarray, " n"]) -> Estimate | None:
        """The sum of some parts divided by the sum of their wholes; its std is that of each part's own share.

        Samples of which either is NaN or infinite, and wholes that are not above zero, are left out; None if none are
        left.
        """
        counted = np.isfinite(parts) & np.isfinite(wholes) & (wholes > 0)
        if not counted.any():
            return None
        totals = self.totals(np.stack([np.where(counted, one, 0.0) for one in (parts, wholes)], axis=1))
        low, high = self.interval(totals, lambda sums: sums[:, 0] / sums[:, 1])
        shares = parts[counted] / wholes[counted]
        mean = float(parts[counted].sum() / wholes[counted].sum())
        present = self.present(counted)
        return Estimate(mean=mean, std=float(shares.std()), low=low, high=high, n=len(shares), episodes=present)

    def explained(self, errors: Float[np.ndarray, " n"], wholes: Float[np.ndarray, " n"]) -> Estimate | None:
        """R^2: 1 - the sum of some errors / the sum of their wholes; its std is that of the samples' parts in it.

        Samples of which either is NaN or infinite are left out; None if there are no others, or the wholes are all
        zero.
        """
        counted = np.isfinite(errors) & np.isfinite(wholes)
        if not counted.any() or not wholes[counted].any():
            return None
        totals = self.totals(np.stack([np.where(counted, one, 0.0) for one in (errors, wholes)], axis=1))
        low, high = self.interval(totals, lambda sums: 1 - sums[:, 0] / sums[:, 1])
        own = 1 - errors[counted] / wholes[counted].mean()
        mean, present = float(own.mean()), self.present(counted)
        return Estimate(mean=mean, std=float(own.std()), low=low, high=high, n=len(own), episodes=present)

    def present(self, counted: Bool[np.ndarray, " n"]) -> int:
        """The number of episodes that have one of the samples that count."""
        return len(np.unique(self._cluster[counted]))

    def totals(self, values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "e m"]:
        """Sums over each episode's samples."""
        columns = values.astype(np.float64).T
        return np.stack([np.bincount(self._cluster, column, len(self._clusters)) for column in columns], axis=1)

    def totals_by(
        self, values: Float[np.ndarray, "n m"], group: Int[np.ndarray, " n"], groups: int
    ) -> Float[np.ndarray, "e g m"]:
        """Sums over each episode's samples of each group, whose numbers begin with 0."""
        place, shape = self._cluster * groups + group, (len(self._clusters), groups)
        columns = values.astype(np.float64).T
        return np.stack([np.bincount(place, column, math.prod(shape)).reshape(shape) for column in columns], axis=2)

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
        if len(present) < self._fewest:
            return None, None
        with np.errstate(divide="ignore", invalid="ignore"):
            drawn = statistic(draws(len(present), self._resamples) @ present)
        drawn = drawn[np.isfinite(drawn)]
        if not len(drawn):
            return None, None
        tail = expanded_tail(len(present))
        low, high = np.quantile(drawn, [tail, 1 - tail])
        return float(low), float(high)


def wilson(share: float, count: int) -> tuple[float, float]:
    """The 95% interval of a share of so many independent cases (Wilson 1927): right for 0 and 1 and few cases, too."""
    z = float(ndtri((1 + LEVEL) / 2))
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)


def rank_correlation(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> Estimate | None:
    """Spearman's rank correlation, with a 95% interval by a bootstrap over the pairs; its std is that of the draws.

    None of fewer than ``FEWEST_PAIRS``, and where one of the two is constant. Where both rank all pairs alike, or one
    the other way round, so does every draw: there is no interval.
    """
    count = len(first)
    if count < FEWEST_PAIRS:
        return None
    generator = np.random.default_rng([SEED, count])
    rows = generator.integers(count, size=(RESAMPLES, count))
    all_of_them = float(_ranked_alike(first[None], second[None])[0])
    drawn = _ranked_alike(first[rows], second[rows])
    known = drawn[np.isfinite(drawn)]
    if not len(known) or not np.isfinite(all_of_them):
        return None
    low, high = map(float, np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]))
    is_ordered = high - low < ROUNDING
    return Estimate(
        mean=all_of_them,
        std=float(known.std()),
        low=None if is_ordered else low,
        high=None if is_ordered else high,
        n=count,
    )


def _ranked_alike(first: Float[np.ndarray, "r n"], second: Float[np.ndarray, "r n"]) -> Float[np.ndarray, " r"]:
    """The correlation of the ranks of each two lists; NaN where one is constant."""
    from scipy.stats import rankdata  # loading it takes 0.8 s

    one, other = (rankdata(values, axis=1) - (values.shape[1] + 1) / 2 for values in (first, second))
    size = np.sqrt((one * one).sum(1) * (other * other).sum(1))
    with np.errstate(invalid="ignore"):
        return np.where(size > 0, (one * other).sum(1) / size, np.nan)


def expanded_tail(clusters: int) -> float:
    """Which quantile of the draws bounds the interval: (1 - LEVEL) / 2, made smaller for few clusters."""
    quantile = float(stdtrit(clusters - 1, (1 + LEVEL) / 2))
    return float(ndtr(-math.sqrt(clusters / (clusters - 1)) * quantile))


@lru_cache(maxsize=4)
def draws(episodes: int, resamples: int) -> Float[np.ndarray, "r e"]:
    """The number of times that each draw contains each episode."""
    generator = np.random.default_rng([SEED, episodes])
    return generator.multinomial(episodes, np.full(episodes, 1 / episodes), size=resamples).astype(np.float64)
