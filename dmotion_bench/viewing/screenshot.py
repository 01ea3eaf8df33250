"""An .rrd as pictures, taken by Rerun itself without a window.

Needs a Vulkan driver; a machine without a graphics card has one in Debian's ``mesa-vulkan-drivers``. The pictures of
the documentation are made with it::

    dmbench view RUN --save run.rrd
    python -m dmotion_bench.viewing.screenshot run.rrd picture.png --tab Training --frame 9
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from PIL import Image
from rerun.experimental import ViewerClient

from dmotion_bench.errors import DmbenchError, ViewerError
from dmotion_bench.viewing.scene import FRAME
from dmotion_bench.viewing.viewer import headless

LOAD_SECONDS = 60.0
TOAST_SECONDS = 5.5
"""How long Rerun's own notices stay in the picture's corner."""

BAR = 34
"""Height of the bar with Rerun's menu and warnings about the graphics driver [px]."""

DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")


class Camera:
    """A viewer without a window, showing one .rrd."""

    def __init__(self, client: ViewerClient) -> None:
        self._client = client

    def tab(self, name: str) -> None:
        """Bring a tab to the front.

        Raises:
            ViewerError: There is none of that name.
        """
        layout = self._client.get_blueprint("recording").blueprint
        containers = {
            path: parts["ContainerBlueprint"] for path, parts in layout.items() if "ContainerBlueprint" in parts
        }
        names = {path.strip("/"): facts.get("display_name", "") for path, facts in containers.items()}
        for facts in containers.values():
            for page in facts["contents"] if facts["container_kind"] == "Tabs" else ():
                if names.get(page) == name:
                    facts["active_tab"] = page
                    self._client.set_blueprint(layout, "recording")
                    return
        raise ViewerError(f"no tab named {name!r}; there are: {', '.join(sorted(filter(None, names.values())))}.")

    def views(self) -> dict[str, list[str]]:
        """The views of all tabs by the entity that each is of, and what each complains of, once it has been shown."""
        state = _patiently(self._client.get_state)
        return {view.origin: [report.summary for report in view.reports] for view in state.views}

    def take_view(self, picture: Path, origin: str, *, frame: int) -> None:
        """Write what the view of an entity shows at a frame as a PNG; its tab is to be in front.

        Raises:
            ViewerError: There is none of that entity, or the scene has no frames.
        """
        views = {view.origin: view.view_id for view in _patiently(self._client.get_state).views}
        if origin not in views:
            raise ViewerError(f"no view is of {origin!r}; there are: {', '.join(sorted(views))}.")
        self._go_to(FRAME, frame)
        _patiently(lambda: self._client.save_screenshot(str(picture.resolve()), view_id=views[origin]))

    def _go_to(self, timeline: str, place: int) -> None:
        shown = {one.name for recording in _patiently(self._client.get_state).recordings for one in recording.timelines}
        if timeline not in shown:
            raise ViewerError(f"no timeline {timeline!r}; there are: {', '.join(sorted(shown))}.")
        _patiently(lambda: self._client.set_time(timeline, sequence=place, play_state="paused"))
        time.sleep(0.5)

    def take(self, picture: Path, *, frame: int, timeline: str = FRAME) -> None:
        """Write what is seen at a frame as a PNG, without the window's own bar.

        Raises:
            ViewerError: There is no such timeline.
        """
        self._go_to(timeline, frame)
        _patiently(lambda: self._client.save_screenshot(str(picture.resolve())))
        with Image.open(picture) as whole:
            shown = whole.crop((0, BAR, whole.width, whole.height)).convert("RGB")
        shown.save(picture, optimize=True)


Answer = TypeVar("Answer")


def _patiently(ask: Callable[[], Answer]) -> Answer:
    """Ask Rerun again if a busy machine exceeds Rerun's own limit of 15 s."""
    end = time.monotonic() + LOAD_SECONDS
    while True:
        try:
            return ask()
        except TimeoutError:
            if time.monotonic() > end:
                raise ViewerError(f"Rerun did not answer within {LOAD_SECONDS:.0f} s.") from None


def has_vulkan() -> bool:
    """Whether a Vulkan driver is installed."""
    named = [Path(path) for path in os.environ.get("VK_ICD_FILENAMES", "").split(os.pathsep) if path]
    return any(path.is_file() for path in named) or any(any(Path(f).glob("*.json")) for f in DRIVER_FOLDERS)


@contextlib.contextmanager
def camera(rrd: Path, width: int = 1600, height: int = 900, settle: float = TOAST_SECONDS) -> Iterator[Camera]:
    """A camera on an .rrd that has been loaded.

    Args:
        rrd: What is shown.
        width, height: Of the pictures [px].
        settle: Waited before the first picture [s], for Rerun's notices to leave.

    Raises:
        ViewerError: No driver is there, or the file is not shown within a minute.
    """
    if not rrd.is_file():
        raise ViewerError(f"no file {str(rrd)!r} to take a picture of.")
    if not has_vulkan():
        raise ViewerError("pictures need a Vulkan driver; on Debian: 'apt-get install mesa-vulkan-drivers'.")
    with headless(rrd, width, height) as address:
        client = ViewerClient.connect(address)
        _wait_until_loaded(client, rrd)
        time.sleep(settle)
        yield Camera(client)


def _wait_until_loaded(client: ViewerClient, rrd: Path) -> None:
    end = time.monotonic() + LOAD_SECONDS
    while time.monotonic() < end:
        with contextlib.suppress(RuntimeError, ConnectionError, TimeoutError):  # it listens before it answers
            state = client.get_state()
            if not state.loading and any(recording.timelines for recording in state.recordings):
                return
        time.sleep(0.1)
    raise ViewerError(f"Rerun did not show {str(rrd)!r} within {LOAD_SECONDS:.0f} s.")


def main() -> None:
    """Take one picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("rrd", type=Path)
    parser.add_argument("picture", type=Path, help="a PNG")
    parser.add_argument("--tab", help="the name on a tab; the one in front if left out")
    parser.add_argument("--frame", type=int, default=0, help="the place on the timeline")
    parser.add_argument("--timeline", default=FRAME, help="of a plan and of a training 'step'; 'frame' if left out")
    parser.add_argument("--width", type=int, default=1600)
    parser.add_argument("--height", type=int, default=900)
    given = parser.parse_args()
    try:
        with camera(given.rrd, given.width, given.height) as taken:
            if given.tab is not None:
                taken.tab(given.tab)
            taken.take(given.picture, frame=given.frame, timeline=given.timeline)
    except DmbenchError as error:
        sys.exit(f"dmbench: {error}")


if __name__ == "__main__":
    main()
