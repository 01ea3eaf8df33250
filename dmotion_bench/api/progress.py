"""How a caller is told how far the work is: by a function, by a bar, or not at all."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from dmotion_bench.errors import UsageError
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.wording import shown

Tell = Callable[[JobProgress], None]
"""A function that is told what is done now, and how much of how much."""

Progress = Tell | bool | None
"""The argument ``progress`` of every long function: a function, True for a bar, None or False for silence."""


@contextlib.contextmanager
def telling(progress: Progress) -> Iterator[Tell]:
    """The function to tell; a bar lasts as long as the block.

    Args:
        progress: What the caller gave. A bar is shown in a notebook, or on stderr where that is a terminal.

    Raises:
        UsageError: It is something else.
    """
    if callable(progress):
        yield progress
    elif progress is True:
        with _bar() as tell:
            yield tell
    elif progress is None or progress is False:
        yield lambda _: None
    else:
        raise UsageError(f"progress is {shown(progress)}; give a function, True for a bar, or None.")


@contextlib.contextmanager
def _bar() -> Iterator[Tell]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[status]}"),
        TimeRemainingColumn(),
    )
    shown = console.is_terminal or console.is_jupyter
    with Bar(*columns, console=console, disable=not shown, transient=True) as bar:
        task = bar.add_task("", total=None, status="")

        def tell(told: JobProgress) -> None:
            bar.update(task, description=told.what, completed=told.done, total=told.total, status=told.status)

        yield tell
