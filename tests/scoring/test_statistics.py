"""Intervals that hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from dmotion_bench.scoring.statistics import EpisodeBootstrap, expanded_tail, paired_difference


@pytest.mark.parametrize("episodes", [8, 60])
def test_the_interval_covers_the_truth_as_often_as_it_says(episodes: int) -> None:
    generator = np.random.default_rng(1)
    truth, inside, trials = 5.0, 0, 1500
    for _ in range(trials):
        length = generator.integers(5, 15, episodes)
        episode = np.repeat(np.arange(episodes), length)
        # the steps of an episode share half of their variance; lengths tell nothing about values
        values = truth + generator.normal(0, 1, episodes)[episode] + generator.normal(0, 1, len(episode))
        estimate = EpisodeBootstrap(episode, resamples=500).mean(values)
        assert estimate is not None
        assert estimate.low is not None
        assert estimate.high is not None
        inside += estimate.low <= truth <= estimate.high

    assert 0.93 <= inside / trials <= 0.97


def test_an_interval_over_samples_would_be_too_narrow() -> None:
    generator = np.random.default_rng(2)
    episode = np.repeat(np.arange(40), 25)
    values = generator.normal(0, 1, 40)[episode] + 0.1 * generator.normal(0, 1, 1000)

    by_episode, by_sample = (EpisodeBootstrap(one).mean(values) for one in (episode, np.arange(1000)))

    assert by_episode is not None
    assert by_sample is not None
    assert by_episode.mean == by_sample.mean
    assert by_episode.high - by_episode.low > 3 * (by_sample.high - by_sample.low)


def test_mean_std_and_n_are_the_samples_own() -> None:
    values = np.array([1.0, 2.0, np.nan, 6.0])
    estimate = EpisodeBootstrap(np.array([0, 0, 1, 1])).mean(values)

    assert estimate is not None
    assert (estimate.mean, estimate.n) == (3.0, 3)
    assert estimate.std == pytest.approx(np.std([1, 2, 6]))
    assert estimate.low == pytest.approx(1.5, abs=1e-9)  # only the first episode, drawn twice
    assert estimate.high == pytest.approx(6.0, abs=1e-9)


def test_the_same_seed_gives_the_same_interval_and_order_is_nothing() -> None:
    generator = np.random.default_rng(3)
    episode, values = np.repeat(np.arange(20), 7), generator.random(140)
    order = generator.permutation(140)

    first = EpisodeBootstrap(episode, seed=5).mean(values)
    again = EpisodeBootstrap(episode[order], seed=5).mean(values[order])
    other = EpisodeBootstrap(episode, seed=6).mean(values)

    assert first is not None
    assert again is not None
    assert (first.low, first.high) == pytest.approx((again.low, again.high), rel=1e-12)
    assert first != other


def test_one_episode_has_no_interval_and_no_sample_no_figure() -> None:
    bootstrap = EpisodeBootstrap(np.zeros(5, int))
    estimate = bootstrap.mean(np.arange(5.0))

    assert estimate is not None
    assert (estimate.low, estimate.high) == (None, None)
    assert bootstrap.mean(np.full(5, np.nan)) is None


def test_a_paired_difference_sees_what_two_intervals_hide() -> None:
    generator = np.random.default_rng(4)
    episode = np.repeat(np.arange(30), 10)
    hard = 10 * generator.normal(0, 1, 30)[episode]
    worse, better = hard + 1 + 0.1 * generator.normal(0, 1, 300), hard

    difference = paired_difference(worse, better, episode)
    apart = [EpisodeBootstrap(episode).mean(values) for values in (worse, better)]

    assert difference is not None
    assert difference.low > 0.9
    assert difference.high < 1.1
    assert apart[1].high > apart[0].low


def test_few_episodes_widen_the_interval_and_many_leave_it() -> None:
    assert expanded_tail(100_000) == pytest.approx(0.025, abs=1e-5)
    assert expanded_tail(10) < 0.0125
