"""Shards made on this machine: in this process, or in a pool of processes."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Final

from dmotion_bench.recording.executor import Executor, Job, JobQueue, Result


class SerialExecutor:
    """Runs the jobs in this process, one after the other."""

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
        queue = JobQueue(jobs, "a worker process")
        running: dict[Future[Result], tuple[int, Job]] = {}
        pool = self._pool()
        finished = False
        try:
            while True:
                broken = self._start(pool, function, queue, running)
                if not running:
                    break
                done = wait(running, return_when=FIRST_COMPLETED).done
                broken = broken or any(isinstance(future.exception(), BrokenProcessPool) for future in done)
                if broken:  # and with it whatever was running or waiting in it
                    done = wait(running).done
                    pool.shutdown(wait=True, cancel_futures=True)
                    pool = self._pool()
                for future in done:
                    number, job = running.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        queue.lost(number, job)
                    else:
                        yield future.result()
            finished = True
        finally:
            if not finished:
                _stop(pool)
            pool.shutdown(wait=True, cancel_futures=True)

    def _pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self._workers, mp_context=get_context("spawn"), initializer=_become_worker, initargs=(os.getpid(),)
        )

    def _start(
        self,
        pool: ProcessPoolExecutor,
        function: Callable[[Job], Result],
        queue: JobQueue[Job],
        running: dict[Future[Result], tuple[int, Job]],
    ) -> bool:
        """Submit jobs to the pool; returns whether the pool is broken."""
        while len(running) <= self._workers:  # one more than can run, so that nobody waits
            job = queue.next()
            if job is None:
                break
            try:
                running[pool.submit(function, job[1])] = job
            except BrokenProcessPool:
                queue.lost(*job)
                return True
        return False


def _stop(pool: ProcessPoolExecutor) -> None:
    """Stop the workers at once; files that they have not renamed yet are lost without harm."""
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
    """An executor with one process or several."""
    return SerialExecutor() if workers <= 1 else LocalExecutor(workers)


def available_workers() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
