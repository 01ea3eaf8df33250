"""Jobs run on this machine: in this process, or in several beside each other."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver, get_context, parent_process, resource_tracker
from multiprocessing.context import BaseContext
from threading import Thread
from typing import Final, cast

from dmotion_bench.errors import DmbenchError
from dmotion_bench.execution.executor import Executor, Job, JobQueue, Result, Sendable
from dmotion_bench.execution.processes import NO_ROOM, end_with
from dmotion_bench.interrupts import stop_between_steps, times_received

BEGINNINGS: Final = "dmotion_bench.execution.beginnings"
"""What the server of processes loads to leave Ctrl-C to the command, and to say nothing of one that comes too late."""


class SerialExecutor:
    """Runs the jobs in this process, one after the other."""

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Generator[Result, None, None]:
        """The results, in the order of the jobs."""
        yield from map(function, jobs)


class LocalExecutor:
    """Processes on this machine; they end with their parent, however it ends.

    Each is a pool of its own: a process that is killed costs the job that it was at, and no other. On Linux they are
    forked from one server process, which has loaded the function's module once for all of them.

    Args:
        workers: How many processes.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Generator[Result, None, None]:
        """The results, as they are ready."""
        queue, before = JobQueue(jobs, "a worker process"), times_received()
        with _starting():
            context = _context(function)
        sent = Sendable(function)
        idle: list[ProcessPoolExecutor | None] = [None] * self._workers  # None: not started yet, or killed
        started: list[ProcessPoolExecutor] = []
        running: dict[Future[Result], tuple[ProcessPoolExecutor, int, Job]] = {}
        finished = False
        try:
            while True:
                while idle and (numbered := queue.next()) is not None:
                    if (pool := idle.pop()) is None:
                        pool = _process(context, started)
                    try:
                        with _starting():
                            running[pool.submit(sent, numbered[1])] = (pool, *numbered)
                    except BrokenProcessPool:  # killed while it waited
                        idle.append(None)
                        queue.killed(*numbered)
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    pool, number, job = running.pop(future)
                    if _was_ended(future.exception(), asked=times_received() > before):
                        pool.shutdown()
                        idle.append(None)
                        queue.killed(number, job)
                    else:
                        idle.append(pool)
                        yield future.result()
            finished = True
            queue.end()
        finally:
            if not finished:
                for pool in started:
                    _stop(pool)
            _end(started)


def _was_ended(error: BaseException | None, *, asked: bool) -> bool:
    """Whether a job was lost with its worker, and not because this process was asked to end.

    A worker that is asked to end by a signal may come to its end in order, and send back that it was interrupted.
    """
    return isinstance(error, BrokenProcessPool) or (isinstance(error, KeyboardInterrupt) and not asked)


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Say in a sentence that a process could not be started.

    Raises:
        DmbenchError: The system allows no more processes, or has no memory for one; the server of processes ends with
            an error of its own then, and leaves no more than the end of what it was to say.
    """
    try:
        yield
    except (OSError, EOFError) as error:
        if isinstance(error, OSError) and error.errno not in NO_ROOM:
            raise
        raise DmbenchError(
            "no more worker processes can be started on this machine, perhaps for want of memory; run the same "
            "command again, with fewer '--workers': it goes on where it stopped."
        ) from error


def _context(function: Callable[[Job], Result]) -> BaseContext:
    """How processes begin: never as a fork of this one, whose threads may hold locks."""
    if sys.platform != "linux":  # elsewhere there is no server, or it is less reliable
        return get_context("spawn")
    context = get_context("forkserver")
    loaded = [name for name in (function.__module__, "torch") if name in sys.modules]
    context.set_forkserver_preload([BEGINNINGS, *loaded])
    _start_server(os.getpid())
    return context


@functools.cache
def _start_server(_process: int) -> None:
    """Have the server of this process ready, once: its first process is asked for nothing.

    When it has ended, the server has loaded everything, and the workers begin at once. Until the server has loaded
    ``beginnings``, Ctrl-C would be told there too: it is held back, and the server is started with it held back.
    """
    resource_tracker.ensure_running()  # if the server started it, it would let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    first = get_context("forkserver").Process(target=_nothing)
    first.start()
    first.join()


def _nothing() -> None:
    """What the first process does."""


def _process(context: BaseContext, started: list[ProcessPoolExecutor]) -> ProcessPoolExecutor:
    """One more pool of one process, which joins those that have been started.

    An interruption waits until it is made. A half-made pool would leave semaphores behind, and Python warns of these at
    its end.
    """
    with stop_between_steps() as asked:
        pool = ProcessPoolExecutor(1, mp_context=context, initializer=_become_worker, initargs=(dict(os.environ),))
        started.append(pool)
    if asked():
        raise KeyboardInterrupt
    return pool


def _end(pools: list[ProcessPoolExecutor]) -> None:
    """Ask all pools to end, then wait until they have.

    At its own end Python writes to the pipe of every pool that is left, and fails if the pool closes it meanwhile.
    """
    managers = [cast("Thread | None", pool._executor_manager_thread) for pool in pools]
    for pool in pools:
        pool.shutdown(wait=False, cancel_futures=True)  # the pool drops its thread; a second call would not wait
    for manager in managers:
        if manager is not None and manager.is_alive():
            manager.join()


def _stop(pool: ProcessPoolExecutor) -> None:
    """Stop a worker at once; files that it has not renamed yet are lost without harm."""
    for process in list((pool._processes or {}).values()):
        process.terminate()


def _become_worker(environment: dict[str, str]) -> None:
    """Leave Ctrl-C to the command, take its variables of now, and end when it or the server is gone.

    The server has the variables of its own start; it ends with the last of the command and its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.clear()
    os.environ.update(environment)
    command = parent_process()
    assert command is not None  # a worker is never the first process
    end_with(os.getppid(), command.sentinel)


def local_executor(workers: int) -> Executor:
    """An executor with one process or several."""
    return SerialExecutor() if workers <= 1 else LocalExecutor(workers)
