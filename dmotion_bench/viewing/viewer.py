"""Rerun's programs: a window, a web page, and a headless one that takes pictures.

All are the command-line program that comes with ``rerun-sdk``, given a whole .rrd and told to listen on this
machine's loopback address alone. (Started from Python, its servers listen on every network interface: rerun-io/rerun
#5882.) The web page fetches the .rrd from ``file_server.py``. Each program runs in a process group of its own that
ends with the block it was opened in.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from dmotion_bench.errors import ViewerError
from dmotion_bench.viewing.file_server import LOOPBACK, serving

WEB_PORT, LIVE_PORT = 9090, 9876
START_SECONDS = 30.0


@dataclass(frozen=True, kw_only=True)
class WebViewer:
    """A web page that is being served.

    Attributes:
        url: To open in a browser on this machine.
        page_port, data_port: Over ssh both are forwarded.
        process: Serves until it ends.
    """

    url: str
    page_port: int
    data_port: int
    process: subprocess.Popen[bytes]


@dataclass(frozen=True, kw_only=True)
class LiveViewer:
    """A viewer that shows what is logged as it is logged.

    Attributes:
        address: What a recording connects to.
        page: To open in a browser on this machine; None for a window.
        ports: Over ssh all are forwarded.
        process: The viewer.
    """

    address: str
    page: str | None
    ports: tuple[int, ...]
    process: subprocess.Popen[bytes]


def has_display() -> bool:
    """Whether a window can be opened: always on macOS and Windows, on Linux where a display is named."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def require_display() -> None:
    """See that a window can be opened.

    Raises:
        ViewerError: It cannot; the other ways are named.
    """
    if not has_display():
        raise ViewerError(
            "no display is here to open a window on; look at it in a browser with '--web', "
            "or write it to a file with '--save FILE.rrd' and open that elsewhere."
        )


def show_window(rrd: Path) -> None:
    """Open Rerun's window and wait until it is closed.

    Raises:
        ViewerError: There is no display, or Rerun could not be started.
    """
    require_display()
    with _program("--bind", LOOPBACK, "--port", "auto", "--hide-welcome-screen", str(rrd)) as (process, log):
        if process.wait() != 0:
            raise ViewerError(f"Rerun's window could not be opened: {_reason(log)} Try '--web'.")


@contextlib.contextmanager
def serve_web(rrd: Path) -> Iterator[WebViewer]:
    """Serve the web viewer with this .rrd on the loopback address for as long as the block lasts.

    Raises:
        ViewerError: Rerun could not be started.
    """
    port = _free_port(WEB_PORT)
    with serving(rrd, port) as data:
        options = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port)]
        with _program(*options, data.url) as (process, log):
            _wait_for_port(port, process, log)
            page = f"http://{LOOPBACK}:{port}?url={quote(data.url, safe='')}"
            yield WebViewer(url=page, page_port=port, data_port=data.port, process=process)


@contextlib.contextmanager
def open_live(*, web: bool) -> Iterator[LiveViewer]:
    """A window, or a web page, that waits for a recording, for as long as the block lasts.

    Raises:
        ViewerError: There is no display, or Rerun could not be started.
    """
    if not web:
        require_display()
    port = _free_port(LIVE_PORT)
    address, page = f"rerun+http://{LOOPBACK}:{port}/proxy", None
    ports: tuple[int, ...] = (port,)
    options = ["--bind", LOOPBACK, "--port", str(port)]
    if web:
        page_port = _free_port(WEB_PORT)
        options += ["--serve-web", "--web-viewer-port", str(page_port)]
        page, ports = f"http://{LOOPBACK}:{page_port}?url={quote(address, safe='')}", (port, page_port)
    else:
        options += ["--hide-welcome-screen"]
    with _program(*options) as (process, log):
        for one in ports:
            _wait_for_port(one, process, log)
        yield LiveViewer(address=address, page=page, ports=ports, process=process)


@contextlib.contextmanager
def headless(rrd: Path, width: int, height: int) -> Iterator[str]:
    """The address of a viewer without a window that has this .rrd open.

    Raises:
        ViewerError: No graphics driver is there, or Rerun could not be started.
    """
    port = _free_port(0)
    options = ["--headless", "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    with _program(*options, "--window-size", f"{width}x{height}", str(rrd)) as (process, log):
        _wait_for_port(port, process, log)
        yield f"rerun+http://{LOOPBACK}:{port}/proxy"


@contextlib.contextmanager
def _program(*options: str) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    """Rerun running, and the file that its messages go to."""
    with tempfile.TemporaryDirectory(prefix="dmbench-view-") as folder:
        log = Path(folder) / "log"
        with log.open("wb") as messages:
            process = subprocess.Popen(
                [sys.executable, "-m", "rerun_cli", *options],
                env={**os.environ, "RERUN_APP_ONLY": "true"},  # as Rerun's own spawn() has it: no first-run notice
                stdin=subprocess.DEVNULL,
                stdout=messages,
                stderr=messages,
                start_new_session=True,
            )
        try:
            yield process, log
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the launcher and the viewer that it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=5)
            return


def _wait_for_port(port: int, process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + START_SECONDS
    while time.monotonic() < end:
        if process.poll() is not None:
            raise ViewerError(f"Rerun ended before it listened: {_reason(log)}")
        with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), timeout=1):
            return
        time.sleep(0.05)
    raise ViewerError(f"Rerun did not listen on port {port} within {START_SECONDS:.0f} s: {_reason(log)}")


def _reason(log: Path) -> str:
    """The last thing that the program said."""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    adapter = [line for line in lines if "adapter" in line.lower() and "found" in line.lower()]
    return (adapter or lines or ["it said nothing."])[-1].strip()


def _free_port(wanted: int) -> int:
    """The port wanted if nobody listens on it, else any free one."""
    for port in (wanted, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOOPBACK, port))
            found: int = probe.getsockname()[1]
            return found
    raise ViewerError(f"no free port on {LOOPBACK} to serve Rerun on.")
