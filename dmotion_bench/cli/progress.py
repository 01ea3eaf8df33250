"""Progress on stderr: a bar on a terminal, a line now and then where stderr is a file or a pipe."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TaskProgressColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from dmotion_bench.wording import printable

if TYPE_CHECKING:
    from dmotion_bench.execution.job_progress import JobProgress

QUIET: Final = "DMBENCH_QUIET"
"""Where this environment variable is set, no line of progress and no note is written to a file or a pipe."""

FIRST_SECONDS: Final = 5.0
"""After so long the first line is written, which says how long it will take."""

SECONDS: Final = 15.0
"""Between two lines."""

_NAMED: Final = 5  # jobs in a line of all that run


class _Words(ProgressColumn):
    """Text in one line, which gives way where the others need the room."""

    def __init__(self, words: Callable[[Task], str]) -> None:
        self._words = words
        super().__init__()

    def render(self, task: Task) -> Text:
        return Text(printable(self._words(task)), no_wrap=True, overflow="ellipsis")


def bar_columns(width: int) -> list[ProgressColumn]:
    """What stands beside each other in a line of progress, on a terminal of so many columns."""
    whole = Column(no_wrap=True)
    return [
        _Words(lambda task: task.description),
        BarColumn(bar_width=min(40, max(8, width - 80)), table_column=whole),
        TaskProgressColumn(table_column=whole),
        MofNCompleteColumn(table_column=whole),
        _Words(lambda task: task.fields["status"]),
        TimeElapsedColumn(table_column=whole),
        TimeRemainingColumn(table_column=whole),
    ]


class ProgressDisplay:
    """The progress of one or more pieces of work, one after the other; used as a context manager.

    Args:
        clock: Gives the time in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        terminal, console = sys.stderr.isatty(), Console(stderr=True)
        self._bar = Progress(
            *bar_columns(console.width),
            console=console,
            disable=not terminal,
            transient=True,
        )
        self._clock, self._lines = clock, not (terminal or os.environ.get(QUIET))
        self._began: dict[TaskID, tuple[float, float]] = {}  # when, and how much was done already
        self._jobs: dict[str, TaskID] = {}
        self._told: TaskID | None = None
        self._due = clock() + FIRST_SECONDS

    def show_jobs(self, task: TaskID, jobs: Mapping[str, JobProgress]) -> None:
        """Say how far the jobs of an executor are: a bar each on a terminal, their shares beside ``task`` elsewhere.

        Args:
            task: All of them together.
            jobs: Those that are running, by their names.
        """
        for name in set(self._jobs) - set(jobs):
            self._bar.remove_task(self._jobs.pop(name))
        for name, job in jobs.items():
            if name not in self._jobs:
                self._jobs[name] = self._bar.add_task(job.what, total=job.total, status=job.status, unit=job.unit)
            self._bar.update(
                self._jobs[name], description=job.what, completed=job.done, total=job.total, status=job.status
            )
        self.update(task, status=_together(list(jobs.values())))

    def tell(self, told: JobProgress) -> None:
        """Say how far something is; it takes the place of what was told of something else before."""
        if self._told is None:
            self._told = self.add_task(told.what, total=told.total, status=told.status, unit=told.unit)
        elif self._progress_of(self._told).description != told.what:
            self._restart(self._told)
        done = None if told.total is None else told.done  # before the end is known, nothing has begun
        self.update(
            self._told, description=told.what, completed=done, total=told.total, status=told.status, unit=told.unit
        )

    def watch(self, jobs: Mapping[str, JobProgress]) -> None:
        """Say how far the jobs of an executor are, beside what was told last (``show_jobs``)."""
        if self._told is not None:
            self.show_jobs(self._told, jobs)

    def add_task(self, description: str, *, total: float | None = None, status: str = "", unit: str = "") -> TaskID:
        """A piece of work.

        Args:
            description: What it is.
            total: How much there is to do, if that is known.
            status: Free text beside it.
            unit: What is counted.
        """
        return self._bar.add_task(description, total=total, status=status, unit=unit)

    def update(
        self,
        task: TaskID,
        *,
        description: str | None = None,
        completed: float | None = None,
        total: float | None = None,
        status: str | None = None,
        unit: str | None = None,
    ) -> None:
        """Say how far a piece of work is; what is left out stays as it was."""
        fields = {"status": status, "unit": unit}
        given: dict[str, Any] = {name: value for name, value in fields.items() if value is not None}
        before = self._progress_of(task).completed
        if completed is not None and completed < before:  # another part of the work, counted from the start
            self._restart(task)
        self._bar.update(task, description=description, completed=completed, total=total, **given)
        if not self._lines:
            return
        now = self._clock()
        if completed is not None:
            self._began.setdefault(task, (now, completed))
        if now >= self._due:
            self._due = now + SECONDS
            sys.stderr.write(printable(self._line(task, now)) + "\n")
            sys.stderr.flush()

    def _restart(self, task: TaskID) -> None:
        """Count a task's work and time from the start."""
        self._began.pop(task, None)
        self._bar.reset(task)

    def _line(self, task: TaskID, now: float) -> str:
        known = self._progress_of(task)
        done, total, status = known.completed, known.total, known.fields["status"]
        parts = [] if total is None else [f"{done:,.0f} of {total:,.0f} {known.fields['unit']}".rstrip()]
        parts += [status] if status else []
        began, before = self._began.get(task, (now, done))
        if total is not None and done > before:
            parts.append(f"{duration((total - done) * (now - began) / (done - before))} left")
        return f"{known.description}: {', '.join(parts)}" if parts else str(known.description)

    def _progress_of(self, task: TaskID) -> Task:
        return next(one for one in self._bar.tasks if one.id == task)

    def __enter__(self) -> ProgressDisplay:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


def _together(jobs: Sequence[JobProgress]) -> str:
    """How far jobs are, in a few words: each of them, or of many their number and the slowest."""
    if len(jobs) <= _NAMED:
        return "; ".join(f"{job.what} {_share(job)}" for job in jobs)
    known = [job for job in jobs if job.total]
    slowest = min(known, key=lambda job: job.done / (job.total or 1), default=None)
    return f"{len(jobs)} run" + ("" if slowest is None else f", the slowest {slowest.what} {_share(slowest)}")


def _share(job: JobProgress) -> str:
    return f"{job.done / job.total:.0%}" if job.total else f"{job.done:,.0f}"


def progress_bar() -> ProgressDisplay:
    """A display with a description, how much is done of how much, free text (``status``), and the remaining time."""
    return ProgressDisplay()


class BarOnDemand:
    """Shows what it is told; the display is there from then until ``end``, or the end of the ``with`` block.

    Args:
        poll: Called each time, too.
    """

    def __init__(self, poll: Callable[[], None] = lambda: None) -> None:
        self._poll = poll
        self._display: ProgressDisplay | None = None

    def __call__(self, told: JobProgress) -> None:
        if self._display is None:
            self._display = progress_bar()
            self._display.__enter__()
        self._display.tell(told)
        self._poll()

    def end(self) -> None:
        """Take the display away; what is told next has a new one."""
        if self._display is not None:
            self._display.__exit__(None, None, None)
            self._display = None

    def __enter__(self) -> BarOnDemand:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()


def note(text: str) -> None:
    """Print a line on stderr."""
    text = printable(text)
    if sys.stderr.isatty():
        Console(stderr=True).print(text, highlight=False, markup=False)
    elif not os.environ.get(QUIET):
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


def duration(seconds: float) -> str:
    """So many seconds, for people: ``"2 min 10 s"``."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
