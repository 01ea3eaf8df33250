"""Rerun recordings that are shown while they are made: in a window, on a web page, in a file."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.stdout import say
from dmotion_bench.wording import command

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from dmotion_bench.viewing.follow import Follower

EVERY = 1.0
"""Seconds between two updates."""

Live = Annotated[
    bool,
    typer.Option("--live", help="Show the progress in Rerun: in a window or, without a display, on a local web page."),
]
LiveTo = Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Write what --live shows to a Rerun file.")]


@dataclass(frozen=True)
class Watched:
    """A recording that may be watched while it is made.

    Attributes:
        recording: To log to.
        closed: Whether there was a viewer and it has ended: its window was closed, or it crashed.
    """

    recording: rr.RecordingStream
    closed: Callable[[], bool] = lambda: False


@contextlib.contextmanager
def following(make: Callable[[], Follower], live: bool, to: Path | None) -> Iterator[Callable[[], None]]:
    """A function that shows what is new; call it as often as you like while the work goes on.

    Args:
        make: Makes the view; called only if there is something to show it on.
        live: Whether to open a window, or a web page where there is no display.
        to: A file.

    Raises:
        UsageError: The file is none of Rerun's.
    """
    from dmotion_bench.errors import UsageError

    if to is not None and to.suffix != ".rrd":
        raise UsageError(f"--live-to {str(to)!r} must end in .rrd, as Rerun knows its files by it.")
    if not live and to is None:
        yield lambda: None
        return
    from dmotion_bench.viewing.viewer import has_display

    follower = make()
    window = live and has_display()
    web = live and not window
    with live_recording(follower.title, follower.blueprint(), window=window, web=web, save=to) as shown:
        follower.start(shown.recording)
        looked = time.monotonic()

        def poll() -> None:
            nonlocal looked
            if time.monotonic() - looked >= EVERY:
                follower.poll(shown.recording)
                looked = time.monotonic()

        yield poll
        follower.poll(shown.recording)
    if to is not None:
        say_written(to)


def say_written(file: Path) -> None:
    """Print a Rerun file's path, and how to open it."""
    say(f"{file}")
    say(f"Open it with {command('dmbench view', file)} or {command('rerun', file)}.")


@contextlib.contextmanager
def live_recording(
    title: str,
    blueprint: rrb.Blueprint,
    *,
    window: bool,
    web: bool,
    save: Path | None,
    linger: Callable[[], bool] = lambda: True,
) -> Iterator[Watched]:
    """A Rerun recording to log to. If there is a viewer, it stays open after the block until the user closes it.

    Args:
        title: Of the recording.
        blueprint: The layout.
        window, web, save: Where it is watched; nowhere if none is given.
        linger: Asked at the end of the block whether to wait for the viewer to be closed.
    """
    from dmotion_bench.cli.progress import note
    from dmotion_bench.viewing.live import recording_to
    from dmotion_bench.viewing.viewer import open_live, wait_for

    if not (window or web):
        with recording_to(title, blueprint, file=save) as recording:
            yield Watched(recording)
        return

    with open_live(web=web) as viewer:
        if viewer.page is not None:
            say(viewer.page, err=True)
            forward = " ".join(f"-L {port}:127.0.0.1:{port}" for port in viewer.ports)
            note(f"Open it in a browser on this machine, or on another one after running there 'ssh {forward} HOST'.")
        with recording_to(title, blueprint, address=viewer.address, file=save) as recording:
            yield Watched(recording, lambda: viewer.process.poll() is not None)
        if linger():
            note("Done; close Rerun's window or press Ctrl-C to end." if window else "Done; Ctrl-C ends it.")
            with contextlib.suppress(KeyboardInterrupt):
                wait_for(viewer.process)
