"""Triplets of consecutive frames, gathered in whole batches from the memory-mapped frames.

A triplet is (x_{t-1}, x_t, x_{t+1}); the action that belongs to it is a_t, taken at the middle frame. Frames of
one episode lie one after the other, so a triplet is one contiguous piece of memory and a batch is a handful of
copies: no worker processes, nothing is decoded (decision 008).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8

from dmotion_bench.specs import SplitName
from dmotion_bench.storage.readable import Frames, ReadableDataset

SplitProtocol = Literal["episode", "paper"]
"""``episode`` keeps whole episodes apart; ``paper`` shuffles triplets, as the paper does, and leaks."""


@runtime_checkable
class Triplets(Protocol):
    """Some triplets of a data set, wherever their frames are."""

    def __len__(self) -> int: ...

    def places(self, index: Int[np.ndarray, " b"]) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " b"]]: ...

    def shuffled(self, generator: np.random.Generator) -> Iterator[int]: ...

    def gather(self, index: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b 3 h w 3"]: ...


class TripletSet:
    """Some triplets of a data set.

    Attributes:
        episode: The episode of each triplet.
        step: The number of its middle frame within that episode; the action taken there is ``actions[step]``.
        cache: Where their frames are.
    """

    def __init__(self, cache: Frames, episode: Int[np.ndarray, " n"], step: Int[np.ndarray, " n"]) -> None:
        self.episode, self.step = episode, step
        self._begins = np.asarray(cache.offsets)[episode]
        self._first = self._begins + step - 1
        self.cache = cache

    @classmethod
    def of(cls, cache: Frames, episodes: Int[np.ndarray, " e"]) -> TripletSet:
        """Every triplet of some episodes, in their order."""
        offsets = np.asarray(cache.offsets)
        counts = [max(0, int(offsets[e + 1] - offsets[e]) - 2) for e in episodes]
        steps = [np.arange(1, 1 + count) for count in counts]
        return cls(
            cache,
            np.repeat(np.asarray(episodes, dtype=np.int64), counts),
            np.concatenate(steps) if steps else np.zeros(0, np.int64),
        )

    @classmethod
    def of_split(cls, dataset: ReadableDataset, name: SplitName, protocol: SplitProtocol = "episode") -> TripletSet:
        """The triplets of one part of a data set.

        ``paper`` reproduces the paper's way: all triplets shuffled, a tenth for the test, of the rest a tenth for
        validation. Nine in ten of its test triplets share all frames with the training: it leaks.
        """
        cache = dataset.cache()
        if protocol == "episode":
            return cls.of(cache, dataset.split(name))
        everything = cls.of(cache, np.arange(len(dataset)))
        order = np.random.default_rng(0).permutation(len(everything))
        test = len(order) // 10
        validation = (len(order) - test) // 10
        part = {
            "test": order[:test],
            "validation": order[test : test + validation],
            "train": order[test + validation :],
        }
        return everything.subset(np.sort(part[name]))

    @classmethod
    def apart(cls, cache: Frames, episode: Int[np.ndarray, " n"], step: Int[np.ndarray, " n"]) -> TripletSet:
        """Triplets whose frames have a cache of their own, three by three."""
        apart = cls(cache, np.arange(len(episode)), np.ones(len(episode), np.int64))
        apart.episode, apart.step = episode, step
        return apart

    def __len__(self) -> int:
        return len(self._first)

    def places(self, index: Int[np.ndarray, " b"]) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " b"]]:
        """The episode of each triplet, and the number of its middle frame in it."""
        return self.episode[index], self.step[index]

    def shuffled(self, generator: np.random.Generator) -> Iterator[int]:
        """All triplets in a random order."""
        yield from generator.permutation(len(self)).tolist()

    def subset(self, index: Int[np.ndarray, " m"]) -> TripletSet:
        """These triplets alone, sharing the frames."""
        chosen = object.__new__(TripletSet)
        chosen.episode, chosen.step = self.episode[index], self.step[index]
        chosen._begins, chosen._first, chosen.cache = self._begins[index], self._first[index], self.cache
        return chosen

    @property
    def first_frame(self) -> Int[np.ndarray, " n"]:
        """Where each triplet begins in the cache's frames."""
        first: Int[np.ndarray, " n"] = self._first
        return first

    def gather(
        self, index: Int[np.ndarray, " b"], out: UInt8[np.ndarray, "b 3 h w 3"] | None = None
    ) -> UInt8[np.ndarray, "b 3 h w 3"]:
        """The triplets of a batch: axis 1 is previous, current, next.

        Args:
            index: Which triplets; repeated ones are allowed.
            out: Filled and returned where given, so that a loop allocates once.
        """
        places = self._first[index]
        frames = self.cache.checked(places, 3)
        if out is None:
            out = np.empty((len(index), 3, *frames.shape[1:]), np.uint8)
        for row, first in zip(out, places.tolist(), strict=True):
            row[...] = frames[first : first + 3]
        return out

    def before(self, index: Int[np.ndarray, " b"], count: int) -> Int[np.ndarray, "b k"]:
        """Where the frames before some triplets lie in the cache; an episode's first one is repeated."""
        earlier: Int[np.ndarray, "b k"] = np.maximum(
            self._first[index, None] + np.arange(-count, 0), self._begins[index, None]
        )
        return earlier

    def preceding(self) -> Int[np.ndarray, " n"]:
        """The triplet of this set that comes one step before each of them; -1 where it is not in the set."""
        key = self.episode * _LONGEST + self.step
        order = np.argsort(key)
        place = np.searchsorted(key, key - 1, sorter=order)
        before: Int[np.ndarray, " n"] = order[place]
        return np.where(key[before] == key - 1, before, -1)


_LONGEST: Final = 1 << 40  # more frames than an episode has


def steps_of(epochs: float, triplets: int, batch_size: int) -> int:
    """How many steps make so many passes over the triplets."""
    return max(1, round(epochs * triplets / min(batch_size, triplets)))


class BatchOrder:
    """Which triplets each training step sees: every one once an epoch, in an order that the seed decides.

    The order is a function of (seed, step) alone, so a run that is resumed at a step goes on exactly as it
    would have. Epochs follow each other without a gap; a batch may reach over the seam, so all are full.

    Args:
        triplets: How many there are.
        batch_size: At most all of them, and rounded down to whole groups.
        seed: Of the order.
        episode: Of each triplet; needed for ``together``.
        together: So many triplets of one episode follow each other; what is left of an episode is left out of the
            epoch, others each time. A smaller batch holds a part of such a group.
    """

    def __init__(
        self,
        triplets: int,
        batch_size: int,
        seed: int,
        *,
        episode: Int[np.ndarray, " n"] | None = None,
        together: int = 1,
    ) -> None:
        self.triplets, self.seed = triplets, seed
        self._episode, self._together = episode, together
        self._epoch, self._order = -1, np.zeros(0, np.int64)
        self._length = len(self._epoch_order(0))
        size, most = min(batch_size, triplets), 1 if episode is None else int(np.bincount(episode).max(initial=0))
        self._size = together if together <= min(size, most) else 1  # an item is a triplet, or a group of them
        self.batch_size = size - size % self._size

    def steps(self, epochs: float) -> int:
        """How many steps make so many passes."""
        return steps_of(epochs, self.triplets, self.batch_size)

    def batch(self, step: int) -> Int[np.ndarray, " b"]:
        """The triplets of one step."""
        place, left, parts = step * self.batch_size, self.batch_size, []
        while left:
            epoch, offset = divmod(place, self._length)
            part = self._epoch_order(epoch)[offset : offset + left]
            parts.append(part)
            place, left = place + len(part), left - len(part)
        return np.concatenate(parts)

    def mixed_batch(self, step: int, losses: Float[np.ndarray, " n"], share: float) -> Int[np.ndarray, " b"]:
        """A batch of which a share is drawn by the triplets' latest losses, once every triplet has one.

        Triplets that follow each other are drawn by the mean of their losses, once one of them has one.

        Args:
            losses: Latest loss of each triplet, NaN for one not yet seen.
            share: Of the batch; the rest goes on evenly through the epochs.
        """
        even = self.batch(step)
        if not share:
            return even
        groups = self._groups(step)
        known = losses if groups is None else mean_losses(losses[groups])
        if np.isnan(known).any():
            return even
        hard = int(share * (self.batch_size // self._size))
        generator = np.random.default_rng(np.random.SeedSequence([self.seed, step]))
        drawn = drawn_by_loss(known, hard, generator)
        chosen = drawn if groups is None else groups[drawn].reshape(-1)
        return np.concatenate([even[len(chosen) :], chosen])

    def share(self, batch: Int[np.ndarray, " b"], rank: int, world: int) -> Int[np.ndarray, " s"]:
        """The part of a batch that one of several processes computes; triplets that belong together stay so.

        Args:
            batch: Of one step; at least as many triplets as processes.
            rank: Number of the process.
            world: How many processes there are.
        """
        groups = len(batch) // self._together
        unit = self._together if groups >= world else 1
        first, stop = (unit * (len(batch) // unit * place // world) for place in (rank, rank + 1))
        return batch[first : stop if rank + 1 < world else len(batch)]

    def _groups(self, step: int) -> Int[np.ndarray, "i s"] | None:
        """The triplets of the epoch that a step ends in, an item a row; None where no triplets belong together."""
        if self._episode is None or self._together == 1:
            return None
        return self._epoch_order(((step + 1) * self.batch_size - 1) // self._length).reshape(-1, self._size)

    def _epoch_order(self, epoch: int) -> Int[np.ndarray, " n"]:
        if epoch != self._epoch:
            generator = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(epoch,)))
            order = generator.permutation(self.triplets)
            if self._episode is not None and self._together > 1:
                order = _grouped(order, self._episode, self._together, generator)
            self._epoch, self._order = epoch, order
        return self._order


def mean_losses(losses: Float[np.ndarray, "i s"]) -> Float[np.ndarray, " i"]:
    """The mean of the losses that are known in each row, which stands for those that are not; NaN where none is.

    Args:
        losses: Of the triplets of each item, NaN for one not yet seen.
    """
    known = ~np.isnan(losses)
    total = losses.sum(axis=1, where=known)
    mean: Float[np.ndarray, " i"] = np.where(known.any(axis=1), total, np.nan) / np.maximum(known.sum(axis=1), 1)
    return mean.astype(losses.dtype)


def drawn_by_loss(losses: Float[np.ndarray, " n"], count: int, generator: np.random.Generator) -> Int[np.ndarray, " m"]:
    """Numbers of triplets, drawn by the square roots of their losses; evenly where all losses are zero.

    Args:
        losses: Of each triplet; finite and not below zero.
        count: Numbers to draw; one may come several times.
        generator: Of the random numbers.
    """
    weights = np.sqrt(losses)
    bounds = np.cumsum(weights if weights.any() else np.ones_like(weights))
    places = np.searchsorted(bounds, generator.random(count) * bounds[-1], side="right")
    drawn: Int[np.ndarray, " m"] = np.minimum(places, len(losses) - 1)
    return drawn


def _grouped(
    order: Int[np.ndarray, " n"], episode: Int[np.ndarray, " n"], size: int, generator: np.random.Generator
) -> Int[np.ndarray, " m"]:
    """Groups of one episode each, in any order; the triplets as they are where no episode has enough of them."""
    by_episode = order[episode[order].argsort(kind="stable")]
    counts = np.unique(episode, return_counts=True)[1]
    place = np.arange(len(order)) - np.repeat(counts.cumsum() - counts, counts)  # within its episode
    whole = place < np.repeat(counts - counts % size, counts)
    if not whole.any():
        return order
    groups = by_episode[whole].reshape(-1, size)
    grouped: Int[np.ndarray, " m"] = groups[generator.permutation(len(groups))].reshape(-1)
    return grouped
