"""A recording that is watched while it is made: in a window, on a web page, in a file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb


@contextlib.contextmanager
def live_recording(
    title: str, blueprint: rrb.Blueprint, *, window: bool, web: bool, save: Path | None, linger: bool = True
) -> Iterator[rr.RecordingStream]:
    """A recording to log to; after the block the viewer, if there is one, stays open until it is closed.

    Args:
        title: Of the recording.
        blueprint: The layout.
        window, web, save: Where it is watched; nowhere if none is given.
        linger: Whether to wait for the viewer to be closed.
    """
    import signal

    from dmotion_bench.cli.progress import note
    from dmotion_bench.viewing.live import recording_to
    from dmotion_bench.viewing.viewer import open_live

    if not (window or web):
        with recording_to(title, blueprint, file=save) as recording:
            yield recording
        return

    def leave(_signal: int, _frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, leave)  # else Rerun would outlive this process
    with open_live(web=web) as viewer:
        if viewer.page is not None:
            typer.echo(viewer.page, err=True)
            forward = " ".join(f"-L {port}:127.0.0.1:{port}" for port in viewer.ports)
            note(f"Open it in a browser on this machine, from another one after 'ssh {forward} HOST'.")
        with recording_to(title, blueprint, address=viewer.address, file=save) as recording:
            yield recording
        if linger:
            note("Done; close Rerun's window or press Ctrl-C to end." if window else "Done; Ctrl-C ends it.")
            with contextlib.suppress(KeyboardInterrupt):
                viewer.process.wait()
