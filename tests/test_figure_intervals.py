"""Intervals and spreads as tables show them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dmotion_bench.figure_intervals import interval_of, interval_words, mean_and_spread
from dmotion_bench.scoring.identification import motion_within_over_between
from dmotion_bench.scoring.statistics import EpisodeBootstrap

RATIO = "motion_within_over_between"


def figure(mean: float, low: float | None, high: float | None) -> dict[str, float | int | None]:
    return {"mean": mean, "std": 0.0, "low": low, "high": high, "n": 1604}


@pytest.mark.parametrize(("truth", "by_quantiles"), [(1.0, 0.95), (100.0, 0.05)])
def test_the_interval_of_a_ratio_of_variances_covers_the_truth(truth: float, by_quantiles: float) -> None:
    """Latents of 16 numbers, four actions, and 20 episodes of 20 to 60 triplets that share a tenth of the variance."""
    generator = np.random.default_rng(1)
    centres = np.eye(16)[:4] - np.eye(16)[:4].mean(0)
    centres *= math.sqrt(1 / truth / np.square(centres).sum(1).mean())
    quantiles = shown = 0
    trials = 60
    for _ in range(trials):
        episode = np.repeat(np.arange(20), generator.integers(20, 60, 20))
        action = generator.integers(0, 4, len(episode))
        noise = math.sqrt(0.9) * generator.normal(size=(len(episode), 16))
        noise += math.sqrt(0.1) * generator.normal(size=(20, 16))[episode]
        found = motion_within_over_between(
            centres[action] + noise / 4, action, EpisodeBootstrap(episode, resamples=400)
        )
        assert found is not None
        assert found.low is not None
        assert found.high is not None
        low, high = interval_of(RATIO, found.to_json()) or (math.nan, math.nan)
        quantiles += found.low <= truth <= found.high
        shown += low <= truth <= high
        assert low <= found.mean <= high

    assert shown / trials >= 0.93
    assert quantiles / trials <= by_quantiles


def test_a_latent_that_may_hold_nothing_has_a_ratio_without_an_upper_end() -> None:
    """As one of LAOM's on Planar Push was published: all draws lie below the figure."""
    published = figure(305.2, 136.4, 264.7)

    assert interval_of(RATIO, published) == (305.2, math.inf)
    assert interval_of(f"{RATIO}[1]", published) == (305.2, math.inf)
    assert interval_words(RATIO, published) == "305 or more"


def test_the_quantiles_are_reflected_at_the_figure_on_the_scale_of_between_over_within() -> None:
    low, high = interval_of(RATIO, figure(0.5, 0.4, 0.55)) or (0, 0)

    assert (1 / low + 1 / 0.55) / 2 == pytest.approx(1 / 0.5)
    assert (1 / high + 1 / 0.4) / 2 == pytest.approx(1 / 0.5)


@pytest.mark.parametrize(
    ("stored", "expected"),
    [((0.0, 0.0, 0.0), (0.0, 0.0)), ((0.5, 0.0, 0.6), (1 / (4 - 1 / 0.6), math.inf)), ((0.5, None, None), None)],
)
def test_a_ratio_of_zero_and_bounds_of_zero(
    stored: tuple[float, float | None, float | None], expected: tuple[float, float] | None
) -> None:
    assert interval_of(RATIO, figure(*stored)) == (None if expected is None else pytest.approx(expected))


def test_other_figures_are_shown_as_they_are_stored() -> None:
    assert interval_of("mse", figure(3.0, 1.0, 2.0)) == (1.0, 2.0)
    assert interval_words("mse", figure(3.0, 1.0, 2.0)) == "1.00 to 2.00"
    assert interval_words("mse", figure(3.0, None, None)) == ""


def test_what_no_sample_has_of_its_own_has_no_spread() -> None:
    assert mean_and_spread("codebook_perplexity[0]", figure(3.0, None, None)) == "3.00"
    assert mean_and_spread("mse", figure(3.0, 3.0, 3.0)) == "3.00 ± 0"
    assert mean_and_spread("mse", figure(3.0, None, None) | {"std": None}) == "3.00"
