"""A scene: what is logged and how it is laid out, written as one .rrd that any Rerun viewer opens.

Everything goes through a file, also what a window or a web page shows at once: Rerun's own servers listen on every
network interface when they are started from Python, its command-line program can be told not to (``viewer.py``).

All episodes of a scene are in one recording, each in an entity tree of its own, ``/episode_12/...``, and each on a
tab of its own. Several recordings in one file are not shown side by side by Rerun 0.41: it opens one of them and
hides the others in a catalogue.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.errors import StorageFull, ViewerError
from dmotion_bench.storage.atomic import atomic_file

FRAME = "frame"
"""The timeline that episodes run on: the number of a frame within its episode."""

ALMOST_FULL = 2**20
"""Bytes: a disk with less is why a file could not be written."""

WHOLE = b"RRF2FOOT"
BEHIND = 16
"""What Rerun 0.41 ends a recording with, and the bytes at most behind it."""


@dataclass(frozen=True, kw_only=True)
class Tab:
    """One page of a scene.

    Attributes:
        name: On the tab.
        layout: Its views.
        log: Puts what they show into a recording.
    """

    name: str
    layout: rrb.Container | rrb.View
    log: Callable[[rr.RecordingStream], None]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that is shown of a data set, a run or a report.

    Attributes:
        name: Of the data set or the run.
        tabs: Its pages.
        front: The name of the page in front; the first if empty.
        step_ns: Time between two frames [ns]; it is played at that pace.
        background: Logged once, for all pages.
    """

    name: str
    tabs: tuple[Tab, ...]
    step_ns: int
    background: Callable[[rr.RecordingStream], None] | None = None
    front: str = ""

    def blueprint(self) -> rrb.Blueprint:
        """The layout: the tabs, and a narrow bar to play them with."""
        front = next((place for place, tab in enumerate(self.tabs) if tab.name == self.front), 0)
        return rrb.Blueprint(
            rrb.Tabs(*(tab.layout for tab in self.tabs), active_tab=front, name=self.name),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(
                state="collapsed", timeline=FRAME, fps=1e9 / self.step_ns, play_state="playing", loop_mode="all"
            ),
            auto_layout=False,
            auto_views=False,
        )


def application_id(name: str) -> str:
    """What Rerun calls a recording of this name; it takes no dots and the like."""
    return re.sub(r"[^\w -]", "_", f"dmbench {name}", flags=re.ASCII)


def write_scene(scene: Scene, path: Path) -> None:
    """Write a scene to an .rrd; the file is whole as soon as it has its name.

    Raises:
        ViewerError: The file cannot be written.
        StorageFull: There is no space left for it.
    """
    with recording_file(path) as temporary:
        try:
            _write(scene, temporary)
        except RuntimeError as error:  # Rerun writes in a thread of its own and says late that it could not
            raise not_written(path, error) from error


@contextlib.contextmanager
def recording_file(path: Path) -> Iterator[Path]:
    """A file for Rerun to write, under another name until the block has ended well and the file is whole.

    Raises:
        ViewerError: It cannot be written.
        StorageFull: There is no space left for it.
    """
    with contextlib.ExitStack() as stack:
        try:
            temporary = Path(stack.enter_context(atomic_file(path)).name)
        except OSError as error:
            raise ViewerError(f"{str(path)!r} cannot be written: {error.strerror}; name another file.") from None
        if _is_full(path):  # Rerun would wait for ever
            raise not_written(path, "the disk is full")
        yield temporary
        if not _is_whole(temporary):  # which Rerun does not say
            raise not_written(path, "its end is missing")


def not_written(path: Path, why: object) -> ViewerError | StorageFull:
    """The error of a recording that could not be written."""
    if _is_full(path):
        return StorageFull(f"no space left on the device for {str(path)!r}; free some, or write it elsewhere.")
    return ViewerError(f"{str(path)!r} could not be written: {why}.")


def _is_full(path: Path) -> bool:
    return shutil.disk_usage(path.parent).free < ALMOST_FULL


def _is_whole(file: Path) -> bool:
    with file.open("rb") as opened:
        opened.seek(max(0, file.stat().st_size - len(WHOLE) - BEHIND))
        return WHOLE in opened.read()


def _write(scene: Scene, path: Path) -> None:
    recording = rr.RecordingStream(application_id(scene.name))
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    try:
        recording.save(path)
        recording.send_blueprint(scene.blueprint())
        recording.send_recording_name(scene.name)
        if scene.background is not None:
            scene.background(recording)
        for tab in scene.tabs:
            tab.log(recording)
        recording.flush()
    finally:
        recording.disconnect()


def picture_view(origin: str, name: str, width: int, height: int) -> rrb.Spatial2DView:
    """A view that shows a picture as large as it can, whatever is drawn over it."""
    bounds = rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height])
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds)
