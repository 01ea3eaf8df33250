"""The options that share a command's work among processes and machines, and the folder where its jobs meet."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.options import EXECUTORS, listed

if TYPE_CHECKING:
    from dmotion_bench.workspace import Workspace

Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="With --all: how many jobs run at a time. Default: as many as there are processors and memory for.",
        show_default=False,
    ),
]
ExecutorName = Annotated[
    str | None,
    typer.Option(
        metavar=listed(EXECUTORS),
        help="With --all: where the jobs run: on this machine, in Ray, or as Slurm jobs.  [default: local]",
        show_default=False,
    ),
]


def require_all(name: str, workers: int | None, executor: str | None) -> None:
    """Refuse the options where there is but one piece of work.

    Raises:
        UsageError: One of them is given.
    """
    from dmotion_bench.errors import UsageError

    if given := [option for option, value in (("--workers", workers), ("--executor", executor)) if value]:
        raise UsageError(f"{' and '.join(given)} shares many runs among workers; give --all to {name} them.")


@contextlib.contextmanager
def jobs_folder(workspace: Workspace) -> Iterator[Path]:
    """A folder of the workspace in which jobs meet; what is left in it at the end is deleted, logs of failures stay."""
    workspace.root.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=".jobs-", dir=workspace.root)).absolute()
    try:
        yield folder
    finally:
        for left in folder.glob("*"):
            if left.is_file():
                left.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            folder.rmdir()  # not while it holds the logs of jobs that failed
