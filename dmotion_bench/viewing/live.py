"""Recordings that are watched while they are made, written to a file, or both."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.viewing.scene import application_id, not_written, recording_file

FLUSH_SECONDS = 60.0


@contextlib.contextmanager
def recording_to(
    name: str, blueprint: rrb.Blueprint, *, address: str | None = None, file: Path | None = None
) -> Iterator[rr.RecordingStream]:
    """A recording whose data go to a viewer and to a file, where they are given.

    The file has its name when the block has ended well; whatever ends it otherwise, nothing is left.

    Args:
        name: Shown by the viewer.
        blueprint: The layout.
        address: Of a viewer that listens.
        file: An .rrd.

    Raises:
        ViewerError: The file cannot be written.
        StorageFull: There is no space left for it.
    """
    sinks: list[rr.GrpcSink | rr.FileSink] = [] if address is None else [rr.GrpcSink(address)]
    with contextlib.ExitStack() as stack:
        if file is not None:
            sinks.append(rr.FileSink(stack.enter_context(recording_file(file))))
        recording = rr.RecordingStream(application_id(name))
        stack.callback(recording.disconnect)
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        if sinks:
            recording.set_sinks(*sinks, default_blueprint=blueprint)
        recording.send_recording_name(name)
        yield recording
        try:
            recording.flush(timeout_sec=FLUSH_SECONDS)
        except RuntimeError as error:
            if file is not None and address is None:  # a viewer that was closed meanwhile is no failure
                raise not_written(file, error) from error
