"""The contract of executors, which run jobs of any kind, and the queue that some of them share.

A job is plain values and its result a receipt: whoever runs it needs nothing but these values and a folder that all
machines share. What a job leaves there is the same whoever runs it, and a job that was interrupted can be run again:
so one whose worker was killed is simply run again, ``ATTEMPTS`` times in all. One that is lost then stops no other.
``executors`` makes them by name.
"""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar, runtime_checkable

from dmotion_bench.errors import JobsLost
from dmotion_bench.workspace import Workspace

Job = TypeVar("Job")
Result = TypeVar("Result")
ATTEMPTS: Final = 3  # at one job, before its killed workers are no accident


@dataclass(frozen=True, kw_only=True)
class JobSize:
    """What a cluster is asked for, for each job.

    Attributes:
        processors: How many.
        gigabytes: Of memory.
        gpus: How many.
        minutes: After which a job may be ended; Slurm's own variable ``SBATCH_TIMELIMIT`` comes before it.
    """

    processors: int = 1
    gigabytes: int = 2
    minutes: int = 60
    gpus: int = 0


@runtime_checkable
class Executor(Protocol):
    """Runs a function on jobs; the order of the results is the order in which they are ready."""

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Generator[Result, None, None]:
        """The results. Closing the iterator stops what is not done; function, jobs and results are pickled.

        Raises:
            JobsLost: The workers at some jobs were killed ``ATTEMPTS`` times; raised when all others are done.
            Exception: What the function raises, at once.
        """


class Sendable(Generic[Job, Result]):
    """Calls a function in another process: in the workspace of this one, and what it raises can be sent back.

    An exception whose ``__init__`` takes more than its text cannot be read there: the process that reads it would take
    the worker for a killed one, or fail itself.

    Args:
        function: What is called.
    """

    def __init__(self, function: Callable[[Job], Result]) -> None:
        self._function, self._workspace = function, Workspace(Workspace.current().root.absolute())

    def __call__(self, job: Job) -> Result:
        """What the function returns.

        Raises:
            RuntimeError: The function raised something that cannot be sent; has its kind and its text.
            Exception: What the function raises.
        """
        try:
            with self._workspace.entered():
                return self._function(job)
        except Exception as error:
            try:
                pickle.loads(pickle.dumps(error))  # what this process has just written
            except Exception:
                raise RuntimeError(f"{type(error).__name__}: {error}") from error
            raise


class JobQueue(Generic[Job]):
    """The jobs that are still to be started, those whose workers were killed first."""

    def __init__(self, jobs: Iterable[Job], who: str) -> None:
        self._waiting, self._who = enumerate(jobs), who
        self._again: list[tuple[int, Job]] = []
        self._killed: Counter[int] = Counter()
        self._lost: list[Job] = []

    def next(self) -> tuple[int, Job] | None:
        """A job with its number; None if all are started."""
        return self._again.pop() if self._again else next(self._waiting, None)

    def back(self, number: int, job: Job) -> None:
        """Put a job back into the queue that could not be started; it is the next one."""
        self._again.append((number, job))

    def killed(self, number: int, job: Job) -> None:
        """Put a job back into the queue because its worker has died, or aside if that was the last attempt."""
        self._killed[number] += 1
        if self._killed[number] < ATTEMPTS:
            self._again.append((number, job))
        else:
            self._lost.append(job)

    def end(self, told: str = "") -> None:
        """Say that all other jobs are done.

        Args:
            told: A sentence more of the jobs that were put aside, such as where their logs are.

        Raises:
            JobsLost: Some jobs were put aside.
        """
        if self._lost:
            raise JobsLost(
                f"{self._who} was killed at the same job {ATTEMPTS} times, perhaps for want of memory, or of time on a "
                "cluster; run the same command again, with fewer '--workers': it goes on where it stopped."
                + (told and f" {told}"),
                self._lost,
            )
