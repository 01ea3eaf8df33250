"""Intervals that hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr

from dmotion_bench.scoring.statistics import (
    FEWEST_EPISODES,
    EpisodeBootstrap,
    detectable_difference,
    expanded_tail,
    over_trainings,
    paired_difference,
    rank_correlation,
    standard_error,
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


@pytest.mark.parametrize("episodes", range(1, 6))
def test_too_few_episodes_have_no_interval_and_no_sample_no_figure(episodes: int) -> None:
    episode, values = np.arange(10) % episodes, np.arange(1.0, 11.0)
    bootstrap = EpisodeBootstrap(episode)
    in_all = [
        bootstrap.mean(values),
        bootstrap.ratio(values, values + 1),
        bootstrap.explained(values, values + 1),
        over_trainings(np.ones((3, episodes)), np.ones(episodes)),
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

    difference = paired_difference(worse, better, episode)
    apart = [EpisodeBootstrap(episode).mean(values) for values in (worse, better)]

    assert difference is not None
    assert difference.low > 0.9
    assert difference.high < 1.1
    assert apart[1].high > apart[0].low


def test_few_episodes_widen_the_interval_and_many_leave_it() -> None:
    assert expanded_tail(100_000) == pytest.approx(0.025, abs=1e-5)
    assert expanded_tail(10) < 0.0125


@pytest.mark.parametrize(("between", "trainings"), [(0.0, 3), (0.02, 3), (0.2, 3), (0.1, 1)])
def test_the_interval_over_tasks_and_trainings_covers_the_truth(between: float, trainings: int) -> None:
    """A training's own level differs by ``between``; one training's interval is about that training alone."""
    generator = np.random.default_rng(4)
    inside, trials, tasks = 0, 400, 60
    for _ in range(trials):
        levels = 0.5 + between * generator.normal(size=(trainings, 1))
        task = 0.2 * generator.normal(size=(1, tasks))
        values = levels + task + 0.15 * generator.normal(size=(trainings, tasks))
        truth = 0.5 if trainings > 1 else float(levels[0, 0])
        found = over_trainings(values, np.ones(tasks), resamples=400)
        assert found.low is not None
        assert found.high is not None
        inside += found.low <= truth <= found.high

    assert 0.92 <= inside / trials <= 0.975


def test_over_one_training_it_is_the_interval_over_episodes() -> None:
    generator = np.random.default_rng(5)
    counts, values = np.array([2.0, 1.0, 3.0, 1.0, 2.0]), generator.random(9)
    episode = np.repeat(np.arange(5), counts.astype(int))
    alone = EpisodeBootstrap(episode).mean(values)
    found = over_trainings(np.bincount(episode, values)[None], counts)

    assert alone is not None
    assert (found.mean, found.n) == (pytest.approx(alone.mean), 9)
    assert (found.low, found.high) == pytest.approx((alone.low, alone.high))


def test_an_interval_over_two_trainings_of_a_distance_does_not_reach_below_zero() -> None:
    far_apart = np.array([[0.1] * 30, [0.9] * 30])
    found = over_trainings(far_apart, np.ones(30))
    assert found.low == 0.0
    assert found.high is not None
    assert found.high > 1
    below = over_trainings(far_apart - 0.5, np.ones(30))  # of a figure that can be negative it does
    assert below.low is not None
    assert below.low < -0.5


def test_a_share_has_wilsons_interval() -> None:
    assert wilson(6 / 20, 20) == pytest.approx((0.145, 0.519), abs=1e-3)  # Newcombe 1998, table I's kind of case
    assert wilson(48 / 50, 50) == pytest.approx((0.865, 0.989), abs=1e-3)
    assert wilson(0.0, 20)[0] == 0.0
    assert wilson(0.0, 20)[1] == pytest.approx(0.161, abs=1e-3)


def test_the_smallest_detectable_difference_is_found_in_four_of_five_cases() -> None:
    generator = np.random.default_rng(6)
    tasks, between, each = 100, 0.03, 0.2
    errors, found, trials = [], 0, 800
    true_error = np.sqrt(2 * each**2 / (3 * tasks) + 2 * between**2 / 3)
    apart = detectable_difference(true_error)
    for _ in range(trials):
        shared = generator.normal(size=tasks) * 0.3
        one, other = (
            shared + level + between * generator.normal(size=(3, 1)) + each * generator.normal(size=(3, tasks))
            for level in (0.5 + apart, 0.5)
        )
        errors.append(standard_error(one, other, np.ones(tasks)))
        found += abs(one.mean() - other.mean()) > 1.96 * true_error

    assert found / trials == pytest.approx(0.8, abs=0.04)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(true_error, rel=0.15)


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


def test_sums_of_groups_are_the_sums_of_what_the_groups_hold() -> None:
    """Bit by bit, so that figures stay as they are whichever way their sums are made."""
    generator = np.random.default_rng(0)
    episodes, group, values = generator.integers(7, size=90), generator.integers(3, size=90), generator.random((90, 2))
    bootstrap = EpisodeBootstrap(episodes)

    found = bootstrap.totals_by(values, group, 4)

    for number in range(4):
        alone = np.where((group == number)[:, None], values, 0.0)
        np.testing.assert_array_equal(found[:, number], bootstrap.totals(alone))
