"""The executors by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dmotion_bench.errors import UnknownName
from dmotion_bench.recording.executor import Executor
from dmotion_bench.recording.local_executor import available_workers, local_executor
from dmotion_bench.recording.ray_executor import RayExecutor
from dmotion_bench.recording.slurm_executor import SlurmExecutor


def make_executor(name: str, workers: int | None = None, scratch: Path | None = None) -> Executor:
    """The executor of a name.

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
        "ray": lambda: RayExecutor(workers),
        "slurm": lambda: SlurmExecutor(workers, scratch or Path.cwd() / ".dmbench-jobs"),
    }
    if name not in known:
        raise UnknownName("executor", name, known)
    return known[name]()
