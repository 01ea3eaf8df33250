"""Triplets: what is gathered, how it is split, in which order it is seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.learning.data.triplets import BatchOrder, TripletSet, drawn_by_loss


def test_a_triplet_is_three_frames_of_one_episode(dataset) -> None:
    cache = dataset.cache()
    triplets = TripletSet.of(cache, np.arange(len(dataset)))
    assert len(triplets) == sum(int(b - a) - 2 for a, b in zip(cache.offsets, cache.offsets[1:], strict=False))
    gathered = triplets.gather(np.arange(len(triplets)))
    for row in range(len(triplets)):
        middle = cache.offsets[triplets.episode[row]] + triplets.step[row]
        np.testing.assert_array_equal(gathered[row], cache.frames[middle - 1 : middle + 2])
        assert cache.offsets[triplets.episode[row]] < middle < cache.offsets[triplets.episode[row] + 1] - 1


def test_gather_takes_repeated_indices_and_fills_what_it_is_given(dataset) -> None:
    triplets = TripletSet.of(dataset.cache(), np.arange(3))
    index = np.array([4, 0, 4])
    out = np.zeros((3, 3, 16, 16, 3), np.uint8)
    assert triplets.gather(index, out) is out
    np.testing.assert_array_equal(out, triplets.gather(np.arange(5))[index])


def test_splits_by_episode_share_no_episode(dataset) -> None:
    parts = [TripletSet.of_split(dataset, name) for name in ("train", "validation", "test")]
    train, validation, test = (set(part.episode.tolist()) for part in parts)
    assert train.isdisjoint(validation | test)
    assert validation.isdisjoint(test)


def test_the_papers_split_shuffles_triplets_and_loses_none(dataset) -> None:
    parts = [TripletSet.of_split(dataset, name, "paper") for name in ("train", "validation", "test")]
    everything = np.sort(np.concatenate([part.first_frame for part in parts]))
    np.testing.assert_array_equal(everything, TripletSet.of(dataset.cache(), np.arange(10)).first_frame)
    assert len(parts[2]) == len(everything) // 10


@given(triplets=st.integers(1, 40), batch=st.integers(1, 16), seed=st.integers(0, 5))
@settings(deadline=None, derandomize=True)
def test_every_triplet_is_seen_once_an_epoch(triplets: int, batch: int, seed: int) -> None:
    order = BatchOrder(triplets, batch, seed)
    size = order.batch_size
    seen = np.concatenate([order.batch(step) for step in range(3 * triplets // size + 1)])
    assert all(len(order.batch(step)) == size for step in range(3))
    for epoch in range(3):
        of_epoch = seen[epoch * triplets : (epoch + 1) * triplets]
        if len(of_epoch) == triplets:
            np.testing.assert_array_equal(np.sort(of_epoch), np.arange(triplets))


def test_the_order_is_a_function_of_seed_and_step_alone() -> None:
    through = BatchOrder(23, 5, 1)
    walked = [through.batch(step) for step in range(12)]
    for step in (11, 0, 7, 3):
        np.testing.assert_array_equal(BatchOrder(23, 5, 1).batch(step), walked[step])
    assert any((BatchOrder(23, 5, 2).batch(step) != walked[step]).any() for step in range(12))


@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8), together=st.integers(2, 4), seed=st.integers(0, 3))
@settings(deadline=None, derandomize=True)
def test_moments_of_an_episode_stand_side_by_side(lengths: list[int], together: int, seed: int) -> None:
    episode = np.repeat(np.arange(len(lengths)) * 3, lengths)  # numbers with gaps, as a split leaves them
    order = BatchOrder(len(episode), together, seed, episode=episode, together=together)
    groups = sum(length // together for length in lengths)
    if not groups or len(episode) < together:
        assert len(order.batch(0)) == order.batch_size
        return
    epochs = [np.stack([order.batch(epoch * groups + step) for step in range(groups)]) for epoch in range(2)]
    for walked in epochs:
        assert (episode[walked] == episode[walked][:, :1]).all()
        assert len(np.unique(walked)) == groups * together
        for one, length in enumerate(lengths):
            assert (episode[walked] == 3 * one).sum() == length - length % together


def test_groups_differ_from_epoch_to_epoch() -> None:
    order = BatchOrder(40, 4, 0, episode=np.repeat(np.arange(4), 10), together=4)
    first, second = ({frozenset(order.batch(epoch * 8 + step).tolist()) for step in range(8)} for epoch in range(2))
    assert first != second


@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=8),
    batch=st.integers(4, 30),
    together=st.integers(2, 4),
    share=st.sampled_from([0.0, 0.3, 0.6]),
)
@settings(deadline=None, derandomize=True)
def test_batches_hold_whole_groups_whatever_their_size_and_what_is_drawn(
    lengths: list[int], batch: int, together: int, share: float
) -> None:
    lengths = [*lengths, 2 * batch]
    episode = np.repeat(np.arange(len(lengths)), lengths)
    order = BatchOrder(len(episode), batch, 3, episode=episode, together=together)
    assert order.batch_size == batch - batch % together
    losses = np.full(len(episode), np.nan, np.float32)
    for step in range(2 * len(episode) // order.batch_size + 2):
        mixed = order.mixed_batch(step, losses, share)
        groups = mixed.reshape(-1, together)
        assert (episode[groups] == episode[groups][:, :1]).all()
        assert all(len(set(group)) == together for group in groups.tolist())
        losses[mixed] = 1.0


def test_hard_groups_are_drawn_by_their_mean_losses_though_some_triplets_are_never_seen() -> None:
    episode = np.repeat([0, 1, 2], [10, 3, 9])  # of the second none is seen, of the third always one is left out
    order = BatchOrder(22, 9, 0, episode=episode, together=4)
    losses = np.where(episode == 2, np.float32(np.nan), np.float32(0.0))
    np.testing.assert_array_equal(order.mixed_batch(2, losses, 0.5), order.batch(2))
    losses[episode == 1] = np.nan
    losses[episode == 2] = 5.0
    losses[-1] = np.nan
    for step in range(20):
        mixed, even = order.mixed_batch(step, losses, 0.5), order.batch(step)
        np.testing.assert_array_equal(mixed[:4], even[4:])
        assert (episode[mixed[4:]] == 2).all()


@pytest.mark.parametrize("epochs", [0.5, 1, 3])
def test_steps_follow_the_epochs(epochs: float) -> None:
    assert BatchOrder(100, 10, 0).steps(epochs) == 10 * epochs


def test_hard_triplets_are_drawn_by_the_roots_of_their_losses_and_evenly_where_all_are_zero() -> None:
    generator = np.random.default_rng(0)
    counts = np.bincount(drawn_by_loss(np.array([0.0, 1.0, 4.0, 0.0], np.float32), 3000, generator), minlength=4)
    assert counts[0] == counts[3] == 0
    assert abs(counts[2] / counts[1] - 2) < 0.2
    order = BatchOrder(100, 16, 0)
    zeros = np.zeros(100, np.float32)
    drawn = np.concatenate([order.mixed_batch(step, zeros, 0.5)[8:] for step in range(200)])
    assert np.bincount(drawn, minlength=100).min() > 0
