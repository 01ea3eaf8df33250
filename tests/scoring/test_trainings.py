"""Intervals over episodes and trainings: they cover the truth as often as they say."""

from __future__ import annotations

import numpy as np
import pytest

from dmotion_bench.scoring.statistics import (
    FEWEST_EPISODES,
    EpisodeBootstrap,
)
from dmotion_bench.scoring.trainings import (
    detectable_difference,
    difference_over_trainings,
    over_trainings,
    standard_error,
)


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


def test_an_interval_of_a_distance_does_not_reach_below_zero() -> None:
    far_apart = np.array([[0.1] * 30, [0.9] * 30])
    found = over_trainings(far_apart, np.ones(30))
    assert found.low is not None
    assert found.high is not None
    assert 0.0 <= found.low < 0.1
    assert found.high > 1
    below = over_trainings(far_apart - 0.5, np.ones(30))  # of a figure that can be negative it does
    assert below.low is not None
    assert below.low < -0.5


def test_a_model_that_fails_in_some_trainings_is_told_from_one_that_never_does() -> None:
    """Errors of trainings differ by factors: 94 to 723 lie far above 2.2 to 2.5."""
    episodes = np.linspace(0.5, 1.5, 30)
    failing, sound = (np.array(level)[:, None] * episodes for level in ([94.0, 299.0, 723.0], [2.2, 2.3, 2.5]))
    found = difference_over_trainings(failing, sound, np.ones(30))

    assert found.low is not None
    assert found.low > 0


@pytest.mark.parametrize(
    ("spread", "trainings"),
    [((0.0, 0.0), (3, 3)), ((0.2, 0.2), (3, 3)), ((0.2, 0.02), (3, 3)), ((0.2, 0.2), (5, 3)), ((0.1, 0.1), (3, 1))],
)
def test_the_interval_of_a_difference_covers_the_truth(spread: tuple[float, float], trainings: tuple[int, int]) -> None:
    """Two models on the same tasks, of which some are hard for both; one training alone is compared as it is."""
    generator = np.random.default_rng(8)
    inside, trials, tasks = 0, 400, 60
    for _ in range(trials):
        hard = 0.2 * generator.normal(size=(1, tasks))
        levels = [wide * generator.normal(size=(count, 1)) for wide, count in zip(spread, trainings, strict=True)]
        values = [level + hard + 0.15 * generator.normal(size=(len(level), tasks)) for level in levels]
        truth = sum(sign * float(level[0, 0]) for sign, level in zip((1, -1), levels, strict=True) if len(level) == 1)
        found = difference_over_trainings(*values, np.ones(tasks), resamples=400)
        assert found.low is not None
        assert found.high is not None
        inside += found.low <= truth <= found.high

    assert 0.92 <= inside / trials <= 0.985


def test_trainings_that_differ_hide_a_difference_that_each_pair_shows() -> None:
    """Trainings of one model, told apart by episodes alone: the interval over trainings contains zero."""
    generator = np.random.default_rng(9)
    episodes = 40
    task = generator.normal(size=(1, episodes))
    first, second = (task + np.array(level)[:, None] for level in ([1.0, 1.3, 0.7], [0.9, 0.5, 1.2]))
    alone = difference_over_trainings(first[:1], second[:1], np.ones(episodes))
    found = difference_over_trainings(first, second, np.ones(episodes))

    assert alone.low == pytest.approx(0.1)
    assert found.mean == pytest.approx(1.0 - 2.6 / 3)
    assert found.low is not None
    assert found.high is not None
    assert found.low < 0 < found.high


def test_between_single_trainings_it_is_the_paired_difference() -> None:
    generator = np.random.default_rng(10)
    counts, values = np.array([2.0, 1.0, 3.0, 1.0, 2.0]), generator.random((2, 9))
    episode = np.repeat(np.arange(5), counts.astype(int))
    alone = EpisodeBootstrap(episode).mean(values[0] - values[1])
    found = difference_over_trainings(*(np.bincount(episode, own)[None] for own in values), counts)
    back = difference_over_trainings(*(np.bincount(episode, own)[None] for own in values[::-1]), counts)

    assert alone is not None
    assert (found.mean, found.n) == (pytest.approx(alone.mean), 9)
    assert (found.low, found.high) == pytest.approx((alone.low, alone.high))
    assert (back.low, back.high) == pytest.approx((-alone.high, -alone.low), abs=0.02)


@pytest.mark.parametrize("episodes", range(1, 6))
def test_over_too_few_episodes_there_is_no_interval(episodes: int) -> None:
    sums, counts = np.ones((3, episodes)), np.ones(episodes)
    for estimate in (over_trainings(sums, counts), difference_over_trainings(sums, sums[:2], counts)):
        assert estimate.episodes == episodes
        assert (estimate.low is None) == (estimate.high is None) == (episodes < FEWEST_EPISODES)


@pytest.mark.parametrize("between", [0.0, 0.03, 0.1])
def test_the_smallest_detectable_difference_is_shown_in_four_of_five_cases(between: float) -> None:
    """By the interval itself, which is wide where three trainings differ."""
    generator = np.random.default_rng(6)
    tasks, each, counts, trials = 60, 0.15, np.ones(60), 150

    def measured(apart: float) -> tuple[np.ndarray, np.ndarray]:
        shared = 0.8 + 0.1 * generator.normal(size=tasks)
        one, other = (
            np.abs(shared + more + between * generator.normal(size=(3, 1)) + each * generator.normal(size=(3, tasks)))
            for more in (apart, 0.0)
        )
        return one, other

    apart = detectable_difference([(*measured(0.0), counts) for _ in range(60)])
    assert apart is not None
    shown = 0
    for _ in range(trials):
        found = difference_over_trainings(*measured(apart), counts, resamples=400)
        assert found.low is not None
        shown += found.low > 0

    assert shown / trials == pytest.approx(0.8, abs=0.1)


def test_the_standard_error_of_a_difference_is_that_over_many_repetitions() -> None:
    generator = np.random.default_rng(6)
    tasks, between, each = 100, 0.03, 0.2
    true_error = np.sqrt(2 * each**2 / (3 * tasks) + 2 * between**2 / 3)
    errors = []
    for _ in range(800):
        shared = generator.normal(size=tasks) * 0.3
        one, other = (
            shared + between * generator.normal(size=(3, 1)) + each * generator.normal(size=(3, tasks)) for _ in "ab"
        )
        errors.append(standard_error(one, other, np.ones(tasks)))

    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(true_error, rel=0.15)


def test_without_an_interval_no_difference_is_detectable() -> None:
    few = np.ones((3, FEWEST_EPISODES - 1))
    assert detectable_difference([(few, few + 1, np.ones(FEWEST_EPISODES - 1))]) is None
    assert detectable_difference([]) is None
    assert detectable_difference([(np.ones((3, 30)), np.ones((3, 30)), np.ones(30))]) is None  # nothing differs
