"""Where the shards of a recording are made: in this process, in a pool of processes, one day on a cluster.

A job is a shard, given by plain values, and its result is a receipt: whoever runs it needs nothing but the
recipe and a folder that all machines share.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Final, Protocol, TypeVar, runtime_checkable

from dmotion_bench.errors import DmbenchError, UnknownName

Job = TypeVar("Job")
Result = TypeVar("Result")


@runtime_checkable
class Executor(Protocol):
    """Runs a function on jobs; the order of the results is the order in which they are ready."""

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """The results. Closing the iterator stops what is not done; function, jobs and results are pickled."""


class SerialExecutor:
    """Here, one after the other."""

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """The results, in the order of the jobs."""
        yield from map(function, jobs)


class LocalExecutor:
    """A pool of processes on this machine; they end with their parent, however it ends.

    Args:
        workers: How many processes.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """The results, as they are ready."""
        pool = ProcessPoolExecutor(
            self._workers, mp_context=get_context("spawn"), initializer=_become_worker, initargs=(os.getpid(),)
        )
        waiting = iter(jobs)
        running: set[Future[Result]] = set()
        finished = False
        try:
            while True:
                for job in waiting:
                    running.add(pool.submit(function, job))
                    if len(running) > self._workers:  # one more than can run, so that nobody waits
                        break
                if not running:
                    break
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
            finished = True
        except BrokenProcessPool:
            raise DmbenchError(
                "a worker process was killed, perhaps for want of memory; run the same command again, with "
                "fewer '--workers': it goes on where it stopped."
            ) from None
        finally:
            if not finished:
                _stop(pool)
            pool.shutdown(wait=True, cancel_futures=True)


def _stop(pool: ProcessPoolExecutor) -> None:
    """End the workers at once: what they have not renamed was never there."""
    for process in list((pool._processes or {}).values()):
        process.terminate()


_LOOK_AGAIN: Final = 0.5  # [s]


def _become_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end when it is gone: a killed parent cannot say so itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK_AGAIN)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def local_executor(workers: int) -> Executor:
    """One process or several."""
    return SerialExecutor() if workers <= 1 else LocalExecutor(workers)


def available_workers() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_executor(name: str, workers: int) -> Executor:
    """The executor of a name.

    Raises:
        UnknownName: There is none.
    """
    known = {"local": local_executor}
    if name not in known:
        raise UnknownName("executor", name, known)
    return known[name](workers)
