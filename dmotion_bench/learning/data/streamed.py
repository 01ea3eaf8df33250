"""Triplets that are read from the compressed files while a model trains, for data sets whose frames fit nowhere.

The memory-mapped cache (``frame_cache.py``) holds every frame of a data set, 49 KB each at 128x128 pixels. Here the
open windows of ``streamed_order.py`` are in memory alone, and threads read what comes next. The triplets that a
training validates with are few and always the same: they have a small cache of their own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.data.batches import uploaded
from dmotion_bench.learning.data.streamed_order import StreamedOrder, Window
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.images import images_of_triplets, to_model
from dmotion_bench.learning.model import TripletBatch
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.frame_cache import CacheFile, FrameCache
from dmotion_bench.storage.mcap_reader import Room
from dmotion_bench.storage.read_ahead import ReadAhead
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.workspace import cache_folder

WINDOW: Final = 8192
"""Triplets that are shuffled among each other, where nothing else is said: 400 MB of 128x128 pixels."""
LOADERS: Final = 1
Actions = Int[np.ndarray, " s"] | Float[np.ndarray, "s a"]


class StreamedTriplets:
    """Some triplets of a data set, an episode's first ones each; nothing is kept but a few numbers an episode.

    Attributes:
        dataset: Whose they are.
        episodes: The episodes that have any, ascending.
        counts: Triplets of each of them.
        window: Triplets that are shuffled among each other.
        loaders: Threads that read.
    """

    def __init__(
        self,
        dataset: ReadableDataset,
        episodes: Int[np.ndarray, " e"],
        counts: Int[np.ndarray, " e"],
        *,
        window: int,
        loaders: int = LOADERS,
    ) -> None:
        some = counts > 0
        self.dataset, self.episodes, self.counts = dataset, episodes[some], counts[some]
        self.window, self.loaders = window, loaders
        self._starts = np.concatenate([[0], np.cumsum(self.counts)])

    @classmethod
    def of_split(
        cls, dataset: ReadableDataset, name: SplitName, *, window: int, loaders: int = LOADERS
    ) -> StreamedTriplets:
        """Every triplet of the episodes of a split."""
        episodes = dataset.split(name)
        counts = np.maximum(0, dataset.rows.lengths[episodes] - 2)
        return cls(dataset, episodes, counts, window=window, loaders=loaders)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def places(self, index: Int[np.ndarray, " b"]) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " b"]]:
        """The episode of each triplet, and the number of its middle frame in it."""
        slots = np.searchsorted(self._starts, index, side="right") - 1
        return self.episodes[slots], index - self._starts[slots] + 1

    def shuffled(self, generator: np.random.Generator) -> Iterator[int]:
        """All triplets in a random order; a list of them is made only where more than half are taken."""
        drawn = set[int]()
        while len(drawn) < len(self) / 2:
            number = int(generator.integers(len(self)))
            if number not in drawn:
                drawn.add(number)
                yield number
        left = np.ones(len(self), np.bool_)
        left[list(drawn)] = False
        drawn.clear()
        yield from generator.permutation(np.flatnonzero(left)).tolist()

    def first(self, counts: Int[np.ndarray, " e"]) -> StreamedTriplets:
        """The first few triplets of each episode."""
        return StreamedTriplets(self.dataset, self.episodes, counts, window=self.window, loaders=self.loaders)

    def order(self, batch_size: int, seed: int, together: int = 1) -> StreamedOrder:
        """The order in which a training sees them."""
        shards = self.dataset.rows.columns["shard"][self.episodes]
        return StreamedOrder(self.counts, shards, batch_size, seed, window=self.window, together=together)

    def gather(self, index: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b 3 h w 3"]:
        """A few triplets, whose episodes are read for them: axis 1 is previous, current, next."""
        episodes, steps = self.places(index)
        spec = self.dataset.spec
        gathered = np.empty((len(index), 3, spec.height, spec.width, 3), np.uint8)
        for episode in np.unique(episodes).tolist():
            frames = self.dataset.video(episode)
            for row in np.flatnonzero(episodes == episode).tolist():
                gathered[row] = frames[steps[row] - 1 : steps[row] + 2]
        return gathered

    def picked(self, index: Int[np.ndarray, " b"]) -> TripletSet:
        """A few triplets with a cache of their own, which is made when it is not there.

        Raises:
            CacheNotWritable: It has to be made and its folder can take no file.
            StorageFull: There is no space for it.
        """
        episodes, steps = self.places(index)
        named = hashlib.sha256(f"{self.dataset.fingerprint} {episodes.tolist()} {steps.tolist()}".encode()).hexdigest()
        spec = self.dataset.spec
        file = CacheFile(
            folder=cache_folder(self.dataset.path),
            fingerprint=named,
            count=3 * len(index),
            height=spec.height,
            width=spec.width,
        )
        parts = np.array_split(index, -(-len(index) // _AT_ONCE))
        cache = FrameCache(
            file,
            np.full(len(index), 3, np.int64),
            lambda: file.build(rearrange(self.gather(part), "n t h w c -> (n t) h w c") for part in parts),
        )
        return TripletSet.apart(cache, episodes, steps)


_AT_ONCE: Final = 64  # triplets that are gathered into memory for a cache of their own


@dataclass(frozen=True)
class _Episode:
    """What is in memory of an episode."""

    frames: UInt8[np.ndarray, "t h w 3"]
    actions: Actions | None


class StreamedBatches:
    """Turns indices into batches, from the episodes of the open windows.

    Args:
        triplets: What the indices point into.
        order: The order in which they are asked for.
        actions: Reads the actions of an episode; None where they were not paid for.
        device: Where the batches are to be.
        earlier: So many frames before each triplet come along, and the actions taken there where they were paid for.
    """

    def __init__(
        self,
        triplets: StreamedTriplets,
        order: StreamedOrder,
        actions: Callable[[int], Actions] | None,
        device: torch.device,
        earlier: int = 0,
    ) -> None:
        self.triplets, self.device, self.earlier = triplets, device, earlier
        self._order, self._actions = order, actions
        self._open: tuple[Window, ...] = ()
        self._ahead = ReadAhead(self._read, triplets.loaders)
        dataset = triplets.dataset
        self._fetch = dataset.fetch if isinstance(dataset, Dataset) and dataset.remote is not None else None
        self._fetcher = ThreadPoolExecutor(1, thread_name_prefix="dmbench-fetcher")

    def __len__(self) -> int:
        return len(self.triplets)

    def expect(self, step: int, rank: int, world: int) -> None:
        """Have the episodes read that a process needs for a step, and those that it needs soon."""
        windows = self._order.open_windows(step, self._order.lanes_of(rank, world))
        if windows != self._open:
            self._open = windows
            self._ahead.keep(self._episodes(windows))
            if self._fetch is not None:
                soon = tuple(self._order.next(window) for window in windows)
                self._fetcher.submit(self._fetch, self._episodes(soon))  # what fails here fails again where it is read

    def gather(self, index: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b 3 h w 3"]:
        """The frames of ``index`` as they are stored: axis 1 is previous, current, next."""
        episodes, steps = self.triplets.places(index)
        spec = self.triplets.dataset.spec
        gathered = np.empty((len(index), 3, spec.height, spec.width, 3), np.uint8)
        for row, episode, step in zip(gathered, episodes.tolist(), steps.tolist(), strict=True):
            row[...] = self._ahead[episode].frames[step - 1 : step + 2]
        return gathered

    def __call__(self, index: Int[np.ndarray, " b"]) -> TripletBatch:
        """The triplets of ``index``, images in [-1, 1], channels-last in memory."""
        episodes, steps = self.triplets.places(index)
        stored = uploaded(self.gather(index), self.device)
        previous, current, following = images_of_triplets(stored)
        batch = TripletBatch(
            previous=previous,
            current=current,
            next=following,
            action=self._taken(episodes, steps),
            episode=uploaded(episodes, self.device),
        )
        if not self.earlier:
            return batch
        back = np.arange(-self.earlier, 0)
        return replace(
            batch,
            earlier=self._frames(episodes, np.maximum(steps[:, None] - 1 + back, 0)),
            earlier_action=self._taken(episodes, np.maximum(steps[:, None] + back, 1)),
            history=uploaded(np.minimum(steps - 1, self.earlier), self.device),
        )

    def _frames(self, episodes: Int[np.ndarray, " b"], places: Int[np.ndarray, "b k"]) -> Float[Tensor, "b k c h w"]:
        """Some frames of each of some episodes."""
        pairs = zip(episodes.tolist(), places, strict=True)
        return to_model(uploaded(np.stack([self._ahead[episode].frames[row] for episode, row in pairs]), self.device))

    def _taken(self, episodes: Int[np.ndarray, " b"], steps: Int[np.ndarray, "b ..."]) -> Tensor | None:
        """The actions taken at one or several steps of each of some episodes; None where they were not paid for."""
        if self._actions is None:
            return None
        pairs = zip(episodes.tolist(), steps, strict=True)
        return as_tensor(np.stack([_actions_of(self._ahead[episode])[row] for episode, row in pairs]), self.device)

    def close(self) -> None:
        """Stop reading."""
        self._ahead.close()
        self._fetcher.shutdown(wait=False, cancel_futures=True)

    def _episodes(self, windows: Iterable[Window]) -> list[int]:
        places = [place for window in windows for place in self._order.episodes(window)]
        episodes: list[int] = self.triplets.episodes[places].tolist()
        return episodes

    def _read(self, episode: int, room: Room) -> _Episode:
        actions = None if self._actions is None else self._actions(episode)
        return _Episode(self.triplets.dataset.video(episode, room), actions)


def _actions_of(episode: _Episode) -> Actions:
    assert episode.actions is not None, "episodes are read with their actions where these were paid for"
    return episode.actions
