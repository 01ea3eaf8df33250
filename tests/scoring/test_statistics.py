"""Intervals that hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr

from dmotion_bench.scoring.statistics import (
    FEWEST_EPISODES,
    EpisodeBootstrap,
    expanded_tail,
    rank_correlation,
    wilson,
)


@pytest.mark.slow
@pytest.mark.parametrize(("episodes", "least"), [(FEWEST_EPISODES, 0.88), (8, 0.93), (60, 0.93)])
def test_the_interval_covers_the_truth_as_often_as_it_says(episodes: int, least: float) -> None:
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

    assert least <= inside / trials <= 0.97


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
    estimate = EpisodeBootstrap(np.array([0, 0, 1, 1]), fewest=2).mean(values)

    assert estimate is not None
    assert (estimate.mean, estimate.n, estimate.episodes) == (3.0, 3, 2)
    assert estimate.std == pytest.approx(np.std([1, 2, 6]))
    assert estimate.low == pytest.approx(1.5, abs=1e-9)  # only the first episode, drawn twice
    assert estimate.high == pytest.approx(6.0, abs=1e-9)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_share_that_is_all_alike_has_an_interval_with_a_width(share: float) -> None:
    alike = EpisodeBootstrap(np.arange(20) // 2).mean(np.full(20, share))
    few = EpisodeBootstrap(np.arange(FEWEST_EPISODES - 1)).mean(np.full(FEWEST_EPISODES - 1, share))
    other = EpisodeBootstrap(np.arange(20)).mean(np.arange(20) % 2.0)

    assert alike is not None
    assert few is not None
    assert other is not None
    assert alike.low == alike.high == share
    bounds = (alike.within(0, 1).low, alike.within(0, 1).high)
    assert bounds == pytest.approx(wilson(share, 10))  # episodes, not tasks
    assert share in bounds
    assert (few.within(0, 1).low, few.within(0, 1).high) == (None, None)
    assert other.within(0, 1) == other


def test_shares_between_0_and_1_that_are_all_alike_may_be_anything_where_nobody_looked() -> None:
    """Of frames that all lack one of two objects: others may lack both, or none."""
    alike = EpisodeBootstrap(np.arange(20) // 2).mean(np.full(20, 0.5))
    assert alike is not None

    found, others = alike.within(0, 1), wilson(0.0, 10)[1]

    assert (found.low, found.high) == pytest.approx((0.5 - others / 2, 0.5 + others / 2))


def test_the_order_of_the_samples_changes_no_interval() -> None:
    generator = np.random.default_rng(3)
    episode, values = np.repeat(np.arange(20), 7), generator.random(140)
    order = generator.permutation(140)

    first = EpisodeBootstrap(episode).mean(values)
    again = EpisodeBootstrap(episode[order]).mean(values[order])

    assert first is not None
    assert again is not None
    assert (first.low, first.high) == pytest.approx((again.low, again.high), rel=1e-12)


@pytest.mark.parametrize("episodes", range(1, 6))
def test_too_few_episodes_have_no_interval_and_no_sample_no_figure(episodes: int) -> None:
    episode, values = np.arange(10) % episodes, np.arange(1.0, 11.0)
    bootstrap = EpisodeBootstrap(episode)
    in_all = [
        bootstrap.mean(values),
        bootstrap.ratio(values, values + 1),
        bootstrap.explained(values, values + 1),
    ]

    for estimate in in_all:
        assert estimate is not None
        assert estimate.episodes == episodes
        assert (estimate.low is None) == (estimate.high is None) == (episodes < FEWEST_EPISODES)
    assert bootstrap.mean(np.full(10, np.nan)) is None


def test_episodes_without_a_sample_do_not_count() -> None:
    """Six episodes, of which two have no value: no interval, though the others of these samples have one."""
    episode, values = np.repeat(np.arange(6), 2), np.arange(12.0)
    values[:4] = np.nan
    estimate, whole = (EpisodeBootstrap(episode).mean(one) for one in (values, np.arange(12.0)))

    assert estimate is not None
    assert whole is not None
    assert (estimate.episodes, estimate.low) == (4, None)
    assert (whole.episodes, whole.low is None) == (6, False)


def test_a_paired_difference_sees_what_two_intervals_hide() -> None:
    generator = np.random.default_rng(4)
    episode = np.repeat(np.arange(30), 10)
    hard = 10 * generator.normal(0, 1, 30)[episode]
    worse, better = hard + 1 + 0.1 * generator.normal(0, 1, 300), hard

    difference = EpisodeBootstrap(episode).mean(worse - better)
    apart = [EpisodeBootstrap(episode).mean(values) for values in (worse, better)]

    assert difference is not None
    assert difference.low > 0.9
    assert difference.high < 1.1
    assert apart[1].high > apart[0].low


def test_few_episodes_widen_the_interval_and_many_leave_it() -> None:
    assert expanded_tail(100_000) == pytest.approx(0.025, abs=1e-5)
    assert expanded_tail(10) < 0.0125


def test_a_share_has_wilsons_interval() -> None:
    assert wilson(6 / 20, 20) == pytest.approx((0.145, 0.519), abs=1e-3)  # Newcombe 1998, table I's kind of case
    assert wilson(48 / 50, 50) == pytest.approx((0.865, 0.989), abs=1e-3)
    assert wilson(0.0, 20)[0] == 0.0
    assert wilson(0.0, 20)[1] == pytest.approx(0.161, abs=1e-3)


def test_the_rank_correlation_is_spearmans() -> None:
    generator = np.random.default_rng(7)
    first = generator.random(12).round(1)  # with ties
    second = first + generator.random(12)
    found = rank_correlation(first, second)

    assert found is not None
    assert found.mean == pytest.approx(float(spearmanr(first, second).statistic))
    assert found.low is not None
    assert found.high is not None
    assert found.low < found.mean < found.high
    assert rank_correlation(first[:4], second[:4]) is None  # too few to say anything
    assert rank_correlation(np.ones(8), second[:8]) is None


@pytest.mark.parametrize("sign", [1, -1])
def test_a_rank_correlation_of_rows_that_are_all_in_order_has_no_interval(sign: int) -> None:
    first = np.random.default_rng(7).random(9).round(1)  # with ties
    found = rank_correlation(first, sign * first**3)

    assert found is not None
    assert found.mean == pytest.approx(sign)
    assert (found.low, found.high) == (None, None)


def test_sums_of_groups_are_the_sums_of_what_the_groups_hold() -> None:
    """Bit by bit, so that figures stay as they are whichever way their sums are made."""
    generator = np.random.default_rng(0)
    episodes, group, values = generator.integers(7, size=90), generator.integers(3, size=90), generator.random((90, 2))
    bootstrap = EpisodeBootstrap(episodes)

    found = bootstrap.totals_by(values, group, 4)

    for number in range(4):
        alone = np.where((group == number)[:, None], values, 0.0)
        np.testing.assert_array_equal(found[:, number], bootstrap.totals(alone))
