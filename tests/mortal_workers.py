"""Work that dies, raises or is slow on purpose, in a module that a worker process imports quickly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import psutil

if TYPE_CHECKING:
    from dmotion_bench.execution.executor import Executor
    from dmotion_bench.recording.session import ShardJob
    from dmotion_bench.storage.shard import ShardReceipt


Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class RecordsAndDiesOnce:
    """Records shards; but whoever is the first to be given the third is killed with its file half written."""

    mark: Path

    def __call__(self, job: ShardJob) -> ShardReceipt:
        from dmotion_bench.recording.session import record_shard

        if job.index == 2 and not self.mark.exists():
            self.mark.touch()
            half = job.dataset / "video" / "shard-00002.mcap.0000dead.part"
            half.parent.mkdir(exist_ok=True)
            half.write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)
        return record_shard(job)


def dies_at_one(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def parent_when_begun(number: int) -> int:
    return os.getppid()


@dataclass(frozen=True)
class InterruptedOnce:
    """Whoever is the first to be given number 1 is asked to end, and does so in order, as a training does."""

    mark: Path

    def __call__(self, number: int) -> int:
        from dmotion_bench.interrupts import stop_between_steps

        with stop_between_steps() as asked:
            if number == 1 and not self.mark.exists():
                self.mark.touch()
                os.kill(os.getpid(), signal.SIGTERM)
            if asked():
                raise KeyboardInterrupt
        return number


@dataclass(frozen=True)
class OutOfTimeOnce:
    """Whoever is the first to be given number 1 is told by Slurm that its time is over soon."""

    mark: Path

    def __call__(self, number: int) -> str:
        from submitit.core.job_environment import SignalHandler

        SignalHandler.has_timed_out = lambda _: True
        try:
            if number == 1 and not self.mark.exists():
                self.mark.touch()
                os.kill(os.getpid(), signal.SIGUSR2)
                time.sleep(10)
        except Exception:  # as for a model that fails
            return f"{number} failed"
        return f"{number} done"


@dataclass(frozen=True)
class Losing:
    """An executor that does the jobs in this process, but loses the first."""

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        from dmotion_bench.errors import JobsLost

        first, *others = jobs
        yield from map(function, others)
        raise JobsLost("a worker was killed.", [first])


def kill_confined_readers() -> None:
    """End the processes in which this one has recordings read."""
    from warm_reader import SERVERS

    for child in psutil.Process().children(recursive=True):
        if child.pid in SERVERS or child.status() == psutil.STATUS_ZOMBIE:
            continue
        if any("confined_reader" in word for word in child.cmdline()):
            child.kill()
            while child.is_running() and child.status() != psutil.STATUS_ZOMBIE:
                time.sleep(0.001)


def raises_at_one(number: int) -> int:
    from dmotion_bench.errors import UnknownName

    if number == 1:
        raise UnknownName("shape", "teapot", ["cube"])
    return number


class OfTwo(Exception):
    """Cannot be read by another process: pickle calls its class with its text alone."""

    def __init__(self, text: str, cause: str) -> None:
        super().__init__(f"{text} ({cause})")


def raises_what_cannot_be_sent(number: int) -> int:
    raise OfTwo("the arm is stuck", "motor 3")


@dataclass(frozen=True)
class LeavesTraces:
    """A file that names its process when it begins, and another, much later, when it has ended."""

    folder: Path
    seconds: float

    def __call__(self, number: int) -> int:
        (self.folder / f"{number}.part").write_text(str(os.getpid()))
        (self.folder / f"{number}.part").rename(self.folder / f"begun-{number}")
        if number > 0:
            time.sleep(self.seconds)
        (self.folder / f"ended-{number}").touch()
        return number


@dataclass(frozen=True)
class DiesOnce(Generic[Job, Result]):
    """Does a job; but whoever is the first to be given the victim is killed at its end."""

    function: Callable[[Job], Result]
    mark: Path
    victim: Job

    def __call__(self, job: Job) -> Result:
        done = self.function(job)
        if job == self.victim and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return done


@dataclass(frozen=True)
class Deadly:
    """An executor in which the first worker at the second job is killed."""

    executor: Executor
    mark: Path

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        listed = list(jobs)
        yield from self.executor.map_unordered(DiesOnce(function, self.mark, listed[1]), listed)


def engine(name: str, scratch: Path) -> Executor:
    """Two workers of an engine; ``submitit`` is Slurm's, on this machine."""
    from dmotion_bench.execution.executor import JobSize
    from dmotion_bench.execution.local_executor import LocalExecutor
    from dmotion_bench.execution.ray_executor import RayExecutor
    from dmotion_bench.execution.slurm_executor import SlurmExecutor

    if name == "ray":
        return RayExecutor(2, JobSize(processors=1))
    if name == "submitit":
        return SlurmExecutor(2, scratch, cluster="local")
    return LocalExecutor(2)


def called_apart(module: str, function: str, *paths: Path) -> None:
    """Call a test's function in a process of its own: Ray would leave threads behind in this one."""
    call = f"import sys; from pathlib import Path; import {module} as m; m.{function}('ray', *map(Path, sys.argv[1:]))"
    found = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", call, *map(str, paths)],
        env=os.environ | {"PYTHONPATH": found},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
