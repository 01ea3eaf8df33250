"""The executors by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dmotion_bench.errors import UnknownName
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.executor import Executor, JobSize
from dmotion_bench.execution.local_executor import local_executor
from dmotion_bench.execution.ray_executor import RayExecutor
from dmotion_bench.execution.slurm_executor import SlurmExecutor


def make_executor(
    name: str, workers: int | None = None, scratch: Path | None = None, size: JobSize | None = None
) -> Executor:
    """The executor of a name.

    Args:
        name: ``local``, ``ray`` or ``slurm``.
        workers: How many at a time; None takes the processors of this machine, or of the cluster.
        scratch: A folder that all machines see, for those executors that speak through files.
        size: What a cluster is asked for, for each job.

    Raises:
        UnknownName: There is none.
        PackageNotInstalled: The package that it needs is absent.
    """
    size = size or JobSize()
    known: dict[str, Callable[[], Executor]] = {
        "local": lambda: local_executor(workers or available_workers()),
        "ray": lambda: RayExecutor(workers, size),
        "slurm": lambda: SlurmExecutor(workers, scratch or Path.cwd() / ".dmbench-jobs", size=size),
    }
    if name not in known:
        raise UnknownName("executor", name, known)
    return known[name]()
