"""Episodes read before they are asked for, by threads beside the one that computes.

Unpacking, checksums and copies let go of Python's lock, so that threads read beside each other as processes would,
and what they have read need not be carried from one process to another.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from dmotion_bench.storage.mcap_reader import Room

Read = TypeVar("Read")


class ReadAhead(Generic[Read]):
    """What belongs to each of some episodes; which of them are kept in memory, its owner says.

    Args:
        read: Reads one episode, into memory that it may use again.
        loaders: Threads that read.
    """

    def __init__(self, read: Callable[[int, Room], Read], loaders: int) -> None:
        self._read, self._rooms = read, threading.local()
        self._threads = ThreadPoolExecutor(loaders, thread_name_prefix="dmbench-loader")
        self._kept: dict[int, Future[Read]] = {}

    def keep(self, episodes: Iterable[int]) -> None:
        """Begin to read these episodes, in their order, and forget all others."""
        wanted = dict.fromkeys(episodes)
        for episode in self._kept.keys() - wanted.keys():
            self._kept.pop(episode).cancel()
        for episode in wanted:
            if episode not in self._kept:
                self._kept[episode] = self._threads.submit(self._read_one, episode)

    def __getitem__(self, episode: int) -> Read:
        """One episode: as it was read, once it is; one that is not kept is read now, and not kept."""
        coming = self._kept.get(episode)
        return self._read_one(episode) if coming is None else coming.result()

    def close(self) -> None:
        """Let the threads end, without what they have not begun."""
        self._kept.clear()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _read_one(self, episode: int) -> Read:
        if not hasattr(self._rooms, "own"):
            self._rooms.own = Room()
        return self._read(episode, self._rooms.own)
