"""The options that share a command's work among processes and machines, and a bar for all of it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import typer

from dmotion_bench.api.settings import EXECUTORS
from dmotion_bench.cli.options import listed

if TYPE_CHECKING:
    from rich.progress import TaskID

    from dmotion_bench.execution.job_progress import JobProgress


def workers_option(meaning: str) -> Any:
    """The option ``--workers``, of which this says what it means."""
    return typer.Option(min=1, help=meaning, show_default=False)


def executor_option(what: str) -> Any:
    """The option ``--executor``; ``what`` is done there, in words such as "Where entries are checked"."""
    return typer.Option(
        metavar=listed(EXECUTORS),
        help=f"{what}: on this machine, in Ray, or as Slurm jobs.  [default: local]",
        show_default=False,
    )


def require_all(name: str, workers: int | None, executor: str | None) -> None:
    """Refuse the options where there is but one piece of work.

    Raises:
        UsageError: One of them is given.
    """
    from dmotion_bench.errors import UsageError

    if given := [option for option, value in (("--workers", workers), ("--executor", executor)) if value]:
        raise UsageError(
            f"{' and '.join(given)} shares many runs among workers; give --all or --seeds to {name} several."
        )


@contextlib.contextmanager
def jobs_bar(what: str) -> Iterator[tuple[Callable[[int, int], None], Callable[[Mapping[str, JobProgress]], None]]]:
    """Two functions that show how many jobs are done and how far the running ones are; a bar is there once it is told.

    Args:
        what: All of them together.
    """
    from dmotion_bench.cli.progress import ProgressDisplay, progress_bar

    with contextlib.ExitStack() as stack:
        shown: list[tuple[ProgressDisplay, TaskID]] = []

        def count(done: int, total: int) -> None:
            if not shown:
                bar = stack.enter_context(progress_bar())
                shown.append((bar, bar.add_task(what, total=total)))
            bar, task = shown[0]
            bar.update(task, completed=done, total=total)

        def watch(jobs: Mapping[str, JobProgress]) -> None:
            if shown:
                bar, task = shown[0]
                bar.show_jobs(task, jobs)

        yield count, watch
