"""The order of triplets that are read from the compressed files: shuffled within windows, never all at once.

An epoch has an order of the shards, and of the episodes of each shard. That line of triplets is cut into equal lanes;
a lane is cut into windows, and the triplets of a window are shuffled. Each batch takes its share of every lane, so it
holds triplets from as many places of the data set as there are lanes, and several processes that share a batch read a
part of the lanes each.

All of this is a function of (seed, step): neither how many threads read nor how many processes compute changes it, a
training goes on at any step, and nothing is kept but a few numbers an episode.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.learning.data.triplets import drawn_by_loss, mean_losses, steps_of

LANES: Final = 8
_EPOCHS, _WINDOWS = 2, 3 * LANES  # that are kept: lanes begin their epochs at nearly the same step
_LATE: Final = 3 / 4
"""Of a window; from then on the next one is read."""


class Window(NamedTuple):
    """The number of a window in an epoch of a lane."""

    lane: int
    epoch: int
    number: int


@dataclass(frozen=True)
class _Epoch:
    """The line of an epoch: its episodes, and how many items stand before each."""

    episodes: Int[np.ndarray, " e"]
    before: Int[np.ndarray, " o"]


Key = TypeVar("Key")
Value = TypeVar("Value")


class _Latest(OrderedDict[Key, Value]):
    """The latest few results of a function."""

    def __init__(self, make: Callable[[Key], Value], most: int) -> None:
        super().__init__()
        self._make, self._most = make, most

    def of(self, key: Key) -> Value:
        """The result for ``key``, made if it is not there."""
        if key not in self:
            self[key] = self._make(key)
            if len(self) > self._most:
                self.popitem(last=False)
        self.move_to_end(key)
        return self[key]


class StreamedOrder:
    """Which triplets each training step sees: every one once an epoch, as far as groups of them go without rest.

    Args:
        counts: Triplets of each episode; a triplet's number is its place in that line.
        shards: The file that each episode is in.
        batch_size: At most all triplets.
        seed: Of the order.
        window: Triplets that are shuffled among each other, in all lanes; an episode is read as a whole.
        together: So many triplets of one episode follow each other; what is left of an episode is left out of the
            epoch, others each time.
    """

    def __init__(
        self,
        counts: Int[np.ndarray, " e"],
        shards: Int[np.ndarray, " e"],
        batch_size: int,
        seed: int,
        *,
        window: int,
        together: int = 1,
    ) -> None:
        self.seed, self.triplets = seed, int(counts.sum())
        self._counts, self._starts = counts, np.concatenate([[0], np.cumsum(counts)])
        self._shard_of = np.unique(shards, return_inverse=True)[1]
        self._size = together if together <= min(batch_size, counts.max(initial=0)) else 1
        self._items = counts // self._size  # an item is a triplet, or a group of them
        items = int(self._items.sum())
        a_batch = min(batch_size // self._size, items)
        self.batch_size, self.lanes = a_batch * self._size, min(LANES, a_batch)
        places = np.arange(self.lanes + 1)
        self._bounds = a_batch * places // self.lanes  # of the lanes in a batch
        ends = items * self._bounds // a_batch  # and in an epoch, in the same shares
        self._begins, self._lengths = ends[:-1], np.diff(ends)
        self._shares = np.diff(self._bounds)
        self._window = max(1, window // self._size // self.lanes)
        self._epochs = _Latest(self._epoch, _EPOCHS)
        self._windows = _Latest(self._shuffled, _WINDOWS)

    def steps(self, epochs: float) -> int:
        """How many steps make so many passes."""
        return steps_of(epochs, self.triplets, self.batch_size)

    def batch(self, step: int) -> Int[np.ndarray, " b"]:
        """The triplets of one step, lane by lane."""
        return np.concatenate([self._taken(lane, step) for lane in range(self.lanes)])

    def mixed_batch(self, step: int, losses: Float[np.ndarray, " n"], share: float) -> Int[np.ndarray, " b"]:
        """A batch of which a share is drawn from the open windows by the triplets' latest losses.

        A lane draws once every triplet of its window has a loss. Triplets that follow each other are drawn by the mean
        of their losses, once one of them has one.

        Args:
            losses: Latest loss of each triplet, NaN for one not yet seen.
            share: Of the batch; the rest goes on evenly through the epochs.
        """
        if not share:
            return self.batch(step)
        parts: list[Int[np.ndarray, " m"]] = []
        hard = (share * self._bounds).astype(np.int64)
        for lane, drawn in enumerate(np.diff(hard).tolist()):
            taken = self._taken(lane, step)
            at_hand = self._windows.of(self._spans(lane, step)[-1])
            known = mean_losses(losses[at_hand])
            if drawn and not np.isnan(known).any():
                generator = np.random.default_rng(np.random.SeedSequence([self.seed, step, lane]))
                chosen = at_hand[drawn_by_loss(known, drawn, generator)].reshape(-1)
                taken = np.concatenate([taken[len(chosen) :], chosen])
            parts.append(taken)
        return np.concatenate(parts)

    def share(self, batch: Int[np.ndarray, " b"], rank: int, world: int) -> Int[np.ndarray, " s"]:
        """The part of a batch that one of several processes computes: whole lanes, where there are enough.

        Args:
            batch: Of one step; at least as many triplets as processes.
            rank: Number of the process.
            world: How many processes there are.
        """
        if world <= self.lanes:
            mine = self.lanes_of(rank, world)
            return batch[self._size * self._bounds[mine.start] : self._size * self._bounds[mine.stop]]
        return batch[len(batch) * rank // world : len(batch) * (rank + 1) // world]

    def lanes_of(self, rank: int, world: int) -> range:
        """The lanes that a process needs for its part of the batches."""
        if world > self.lanes:
            return range(self.lanes)
        return range(self.lanes * rank // world, self.lanes * (rank + 1) // world)

    def open_windows(self, step: int, lanes: Sequence[int]) -> tuple[Window, ...]:
        """The windows that a step takes triplets from, and those that follow soon, which are to be read by then."""
        found: dict[Window, None] = {}
        for lane in lanes:
            spans = self._spans(lane, step)
            found |= dict.fromkeys(spans)
            if self._is_late(step, spans[-1]):
                found |= dict.fromkeys([self.next(spans[-1])])
        return tuple(found)

    def episodes(self, window: Window) -> list[int]:
        """The places of a window's episodes among all, in their order in the files."""
        line, (first, stop) = self._epochs.of(window.epoch), self._limits(window)
        slots = np.searchsorted(line.before, [first, stop - 1], side="right") - 1
        places: list[int] = line.episodes[slots[0] : slots[1] + 1].tolist()
        return places

    def next(self, window: Window) -> Window:
        """The window that follows in the lane: in the next epoch after the last one."""
        if self._limits(window)[1] - int(self._begins[window.lane]) < self._lengths[window.lane]:
            return window._replace(number=window.number + 1)
        return Window(window.lane, window.epoch + 1, 0)

    def _taken(self, lane: int, step: int) -> Int[np.ndarray, " m"]:
        """The triplets that a step takes from a lane."""
        share, length = int(self._shares[lane]), int(self._lengths[lane])
        place, parts = step * share, list[Int[np.ndarray, "i s"]]()
        while share:
            epoch, offset = divmod(place, length)
            window = self._at(lane, epoch, offset)
            first = self._limits(window)[0] - int(self._begins[lane])
            part = self._windows.of(window)[offset - first : offset - first + share]
            parts.append(part)
            place, share = place + len(part), share - len(part)
        return np.concatenate(parts).reshape(-1)

    def _spans(self, lane: int, step: int) -> list[Window]:
        """The windows of a lane that a step takes triplets from."""
        share, length = int(self._shares[lane]), int(self._lengths[lane])
        first, last = (self._at(lane, *divmod(place, length)) for place in (step * share, (step + 1) * share - 1))
        found = [first]
        while found[-1] != last:
            found.append(self.next(found[-1]))
        return found

    def _is_late(self, step: int, window: Window) -> bool:
        share, length = int(self._shares[window.lane]), int(self._lengths[window.lane])
        first, stop = (limit - int(self._begins[window.lane]) for limit in self._limits(window))
        epoch, offset = divmod((step + 1) * share, length)
        return epoch > window.epoch or offset - first >= _LATE * (stop - first)

    def _first(self, lane: int) -> int:
        """Items of a lane's first window: other ones in each lane, so that they are not all read at once."""
        return -(-self._window * (lane + 1) // self.lanes)

    def _at(self, lane: int, epoch: int, offset: int) -> Window:
        beyond = offset - self._first(lane)
        return Window(lane, epoch, 0 if beyond < 0 else 1 + beyond // self._window)

    def _limits(self, window: Window) -> tuple[int, int]:
        """The first item of a window in the epoch's line, and the one after its last."""
        first = self._first(window.lane)
        begin = first + (window.number - 1) * self._window if window.number else 0
        stop = min(begin + self._window if window.number else first, int(self._lengths[window.lane]))
        offset = int(self._begins[window.lane])
        return offset + begin, offset + stop

    def _epoch(self, epoch: int) -> _Epoch:
        generator = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(epoch,)))
        rank = generator.permutation(self._shard_of.max() + 1)
        mixed = generator.permutation(len(self._counts))
        order = mixed[rank[self._shard_of[mixed]].argsort(kind="stable")]
        order = order[self._items[order] > 0]
        return _Epoch(order, np.concatenate([[0], np.cumsum(self._items[order])]))

    def _shuffled(self, window: Window) -> Int[np.ndarray, "i s"]:
        """The triplets of a window, an item a row."""
        line = self._epochs.of(window.epoch)
        items = np.arange(*self._limits(window))
        slots = np.searchsorted(line.before, items, side="right") - 1
        episodes, places = line.episodes[slots], items - line.before[slots]
        if self._size > 1:
            steps = np.concatenate(list(self._groups(window.epoch, episodes, places)))
        else:
            steps = places[:, None]
        generator = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=window))
        triplets: Int[np.ndarray, "i s"] = (self._starts[episodes][:, None] + steps)[generator.permutation(len(items))]
        return triplets

    def _groups(
        self, epoch: int, episodes: Int[np.ndarray, " i"], places: Int[np.ndarray, " i"]
    ) -> Iterator[Int[np.ndarray, "j s"]]:
        """The steps of each group, whose episode they are drawn from; any lane would draw the same."""
        for episode in dict.fromkeys(episodes.tolist()):
            seed = np.random.SeedSequence(self.seed, spawn_key=(epoch, episode))
            steps = np.random.default_rng(seed).permutation(self._counts[episode])
            groups = steps[: self._items[episode] * self._size].reshape(-1, self._size)
            yield groups[places[episodes == episode]]
