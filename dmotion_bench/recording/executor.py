"""Executors, which make the shards of a recording: in this process, in a pool of processes, or on a cluster.

A job is a shard, given by plain values, and its result is a receipt: whoever runs it needs nothing but the
recipe and a folder that all machines share. A shard appears whole or not at all and is the same whoever makes it,
so one whose worker was killed is simply made again, ``ATTEMPTS`` times in all.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Final, Generic, Protocol, TypeVar, runtime_checkable

from dmotion_bench.errors import DmbenchError, UnknownName

Job = TypeVar("Job")
Result = TypeVar("Result")
ATTEMPTS: Final = 3  # at one job, before its killed workers are no accident


@runtime_checkable
class Executor(Protocol):
    """Runs a function on jobs; the order of the results is the order in which they are ready."""

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """The results. Closing the iterator stops what is not done; function, jobs and results are pickled.

        Raises:
            DmbenchError: The workers at one job were killed ``ATTEMPTS`` times; and what the function raises.
        """


def killed_too_often(who: str) -> DmbenchError:
    """The error for a job whose worker was killed ``ATTEMPTS`` times."""
    return DmbenchError(
        f"{who} was killed at the same shard {ATTEMPTS} times, perhaps for want of memory; run the same command again, "
        "with fewer '--workers': it goes on where it stopped."
    )


class JobQueue(Generic[Job]):
    """The jobs that are still to be started, those that were lost first."""

    def __init__(self, jobs: Iterable[Job], who: str) -> None:
        self._waiting, self._who = enumerate(jobs), who
        self._again: list[tuple[int, Job]] = []
        self._lost: Counter[int] = Counter()

    def next(self) -> tuple[int, Job] | None:
        """A job with its number; None if all are started."""
        return self._again.pop() if self._again else next(self._waiting, None)

    def lost(self, number: int, job: Job) -> None:
        """Put a job back into the queue because its worker has died.

        Raises:
            DmbenchError: For the last time.
        """
        self._lost[number] += 1
        if self._lost[number] >= ATTEMPTS:
            raise killed_too_often(self._who)
        self._again.append((number, job))


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


def make_executor(name: str, workers: int | None = None, scratch: Path | None = None) -> Executor:
    """The executor of a name; what it needs is imported here, so that its absence is said before anything is done.

    Args:
        name: ``local``, ``ray`` or ``slurm``.
        workers: How many at a time; None takes the processors of this machine, or of the cluster.
        scratch: A folder that all machines see, for those executors that speak through files.

    Raises:
        UnknownName: There is none.
        PackageNotInstalled: The package that it needs is absent.
    """
    known: dict[str, Callable[[], Executor]] = {
        "local": lambda: local_executor(workers or available_workers()),
        "ray": lambda: _ray(workers),
        "slurm": lambda: _slurm(workers, scratch or Path.cwd() / ".dmbench-jobs"),
    }
    if name not in known:
        raise UnknownName("executor", name, known)
    return known[name]()


def _ray(workers: int | None) -> Executor:
    from dmotion_bench.recording.ray_executor import RayExecutor

    return RayExecutor(workers)


def _slurm(workers: int | None, scratch: Path) -> Executor:
    from dmotion_bench.recording.slurm_executor import SlurmExecutor

    return SlurmExecutor(workers, scratch)
