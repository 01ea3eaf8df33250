"""Identification where actions are continuous: the probe's error, and whom a latent action is swapped with."""

from __future__ import annotations

import numpy as np

from dmotion_bench.scoring.identification import far_partners, probe_error


def test_a_latent_that_is_a_linear_map_of_the_action_leaves_no_error() -> None:
    generator = np.random.default_rng(0)
    action = generator.uniform(-1, 1, (60, 2))
    motion = action @ generator.normal(size=(2, 5)) + 3.0
    assert probe_error(motion, action, np.arange(60) // 10).max() < 1e-6


def test_a_latent_that_knows_nothing_leaves_the_actions_variance() -> None:
    generator = np.random.default_rng(0)
    action, motion = generator.uniform(-1, 1, (4000, 2)), generator.normal(size=(4000, 3))
    error = probe_error(motion, action, np.arange(4000) // 40)
    np.testing.assert_allclose(error.mean(), 1 / 3, atol=0.02)


def test_an_episode_is_not_in_its_own_fit() -> None:
    """Odd episodes say the action, even ones its opposite: whoever is fitted on the others is always wrong."""
    generator = np.random.default_rng(0)
    action, episode = generator.uniform(-1, 1, (400, 1)), np.arange(400) // 20
    motion = np.where(episode[:, None] % 2, action, -action)
    np.testing.assert_allclose(probe_error(motion, action, episode), (2 * action[:, 0]) ** 2, atol=0.05)
    assert np.isnan(probe_error(motion[:20], action[:20], episode[:20])).all()  # one episode: nothing to fit it on


def test_partners_are_half_the_list_away() -> None:
    assert far_partners(5).tolist() == [2, 3, 4, 0, 1]
    assert far_partners(1).tolist() == [-1]
