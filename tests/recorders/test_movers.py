"""Movers go as far as they say and nobody can foretell where; followers follow as many actions as they say."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.stats import binom

from dmotion_bench.recording.rollout import record_episode
from recorders.distractors.movers import CORRELATED, FAMILIES, STEP, Followers, Looks
from recorders.grid_world import GridWorld
from recorders.planar_push import PlanarPush


def grown(inside: np.ndarray) -> np.ndarray:
    """With the neighbours of its pixels."""
    wide = inside.copy()
    for axis, way in itertools.product((0, 1), (-1, 1)):
        wide |= np.roll(inside, way, axis)
    return wide


def test_movers_move_as_far_as_is_told() -> None:
    """The middle of a single mover on black, wherever it is whole in the picture."""
    compared = 0
    for seed in range(6):
        env = GridWorld(movers=1)
        episode = record_episode(env, env.policies[env.default_policy](), seed, 20)
        (told,) = env.distracting_motions(seed, (), 19).values()
        own = (episode.frames > 0).any(axis=-1) & (episode.labels.masks == 0)
        things = episode.labels.masks != 0
        for moment in range(19):
            seen = [np.argwhere(own[place])[:, ::-1] for place in (moment, moment + 1)]
            near = [
                len(one) and one.min() > 1 and one.max() < 126 and not grown(things[place])[own[place]].any()
                for one, place in zip(seen, (moment, moment + 1), strict=True)
            ]
            if all(near) and len(seen[0]) == len(seen[1]):
                np.testing.assert_allclose(seen[1].mean(0) - seen[0].mean(0), told[moment], atol=1.0)
                compared += 1
    assert compared > 10


def test_movers_go_where_the_past_does_not_tell() -> None:
    env = PlanarPush(movers=8)
    env.reset(seed=1)
    track = env._video._movers._track  # type: ignore[union-attr]
    places = np.array([track.at(moment)[0] for moment in range(400)])
    env.close()
    steps = (np.diff(places, axis=0) + 76) % 152 - 76
    lengths = np.hypot(steps[..., 0], steps[..., 1])
    assert 1 <= lengths.min() < 1.2
    assert 5.8 < lengths.max() <= 6
    (x, y), (u, v) = np.moveaxis(steps[1:], -1, 0), np.moveaxis(steps[:-1], -1, 0)
    turned = np.abs(x * v - y * u) > 1e-6
    assert binom.cdf(turned.sum(), turned.size, 0.4) > 1e-4
    assert binom.sf(turned.sum(), turned.size, 0.4) > 1e-4
    assert abs(np.corrcoef(lengths[1:].ravel(), lengths[:-1].ravel())[0, 1]) < 0.06


def test_correlated_things_agree_with_the_action_in_the_stated_share() -> None:
    looks = Looks(size=128, shapes=FAMILIES[0], colors=((200, 200, 200),))
    headings, steps, probability = [(0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (1.0, 0.0)], 1500, 0.6
    followers = Followers(np.random.default_rng(2), probability, looks)
    actions, agreed = np.random.default_rng(3).integers(4, size=steps), 0
    for moment, action in enumerate(actions.tolist(), start=1):
        before = np.array(followers.places)
        followers.step(moment, headings[action], headings)
        moved = (np.array(followers.places) - before + looks.around / 2) % looks.around - looks.around / 2
        np.testing.assert_allclose(np.hypot(*moved.T), STEP)
        agreed += int(np.isclose(moved / STEP, headings[action]).all(axis=1).sum())
    low, high = binom.interval(0.999, CORRELATED * steps, probability + (1 - probability) / 4)
    assert low <= agreed <= high


def test_among_continuous_actions_a_thing_agrees_by_following_alone() -> None:
    looks = Looks(size=128, shapes=FAMILIES[0], colors=((200, 200, 200),))
    followers, agreed = Followers(np.random.default_rng(2), 0.3, looks), 0
    for moment in range(1, 1001):
        before = np.array(followers.places)
        followers.step(moment, (0.6, 0.8), None)
        moved = (np.array(followers.places) - before + looks.around / 2) % looks.around - looks.around / 2
        agreed += int(np.isclose(moved / STEP, (0.6, 0.8)).all(axis=1).sum())
    low, high = binom.interval(0.999, CORRELATED * 1000, 0.3)
    assert low <= agreed <= high
