"""Rerun's programs: a window, a web page, and a headless one that takes pictures.

All are the command-line program that comes with ``rerun-sdk``, given a whole .rrd and told to listen on this
machine's loopback address alone. (Started from Python, its servers listen on every network interface: rerun-io/rerun
#5882.) None talks to another machine: of the web page ``page_server.py`` sees to that. Each program runs in a process
group of its own that ends with the block it was opened in, or with this process where that is killed (``guard.py``).
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from dmotion_bench.errors import ViewerError
from dmotion_bench.loopback_server import LOOPBACK
from dmotion_bench.storage.temporary import temporary_folder
from dmotion_bench.viewing.page_server import page_server

WEB_PORT, LIVE_PORT = 9090, 9876
START_SECONDS = 30.0
LOOK_SECONDS = 0.2
LIFE_SECONDS = 300.0
"""Of a viewer without a window: nobody could close it if it hung."""

ENVIRONMENT = {
    "RERUN_APP_ONLY": "true",
    "RUST_LOG": "info",
    "NO_COLOR": "1",
    "CI": "true",
    "HTTPS_PROXY": f"http://{LOOPBACK}:9",
}
"""No first-run notice, as in Rerun's own spawn(), and what it listens on is said in its messages.

It sends no statistics of its use, as on CI (``rerun analytics disable`` would change the user's own settings), and its
question for a newer version ends at the discard port of this machine.
"""
PROXIES = ("all_proxy", "https_proxy")

ATTEMPTS = 3
TAKEN = "Address already in use"


@dataclass(frozen=True, kw_only=True)
class WebViewer:
    """A web page that is being served.

    Attributes:
        url: To open in a browser on this machine.
        port: Over ssh it is forwarded.
        process: Rerun; the page is there until it ends.
    """

    url: str
    port: int
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
    """Raise an error if no window can be opened.

    Raises:
        ViewerError: It cannot; the other ways are named.
    """
    if not has_display():
        raise ViewerError(
            "this machine has no display to open a window on; add '--web' to use a browser, or '--save FILE.rrd' to "
            "write a file that can be opened elsewhere."
        )


def show_window(rrd: Path) -> None:
    """Open Rerun's window and wait until it is closed.

    Raises:
        ViewerError: There is no display, or Rerun could not be started.
    """
    require_display()
    with _program("--bind", LOOPBACK, "--port", "auto", "--hide-welcome-screen", str(rrd)) as (process, log):
        if wait_for(process) != 0:
            raise ViewerError(f"Rerun's window could not be opened: {_reason(log)} Try '--web'.")


@contextlib.contextmanager
def serve_web(rrd: Path) -> Iterator[WebViewer]:
    """Serve the web viewer with this .rrd on the loopback address for as long as the block lasts.

    Raises:
        ViewerError: Rerun could not be started.
    """
    with page_server(WEB_PORT) as (server, folder):
        server.scene = rrd

        def options(ports: Sequence[int]) -> list[str]:
            return ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(ports[0]), server.scene_url]

        with _listening_program(options, 0) as (process, (port,)):
            server.take_over(port, folder)
            yield WebViewer(url=server.page_url(server.scene_url), port=server.port, process=process)


@contextlib.contextmanager
def open_live(*, web: bool) -> Iterator[LiveViewer]:
    """A window, or a web page, that waits for a recording, for as long as the block lasts.

    Raises:
        ViewerError: There is no display, or Rerun could not be started.
    """
    if not web:
        require_display()

        def to_window(ports: Sequence[int]) -> list[str]:
            return ["--bind", LOOPBACK, "--port", str(ports[0]), "--hide-welcome-screen"]

        with _listening_program(to_window, LIVE_PORT) as (process, (port,)):
            yield LiveViewer(address=_source(port), page=None, ports=(port,), process=process)
        return

    def options(ports: Sequence[int]) -> list[str]:
        where = ["--bind", LOOPBACK, "--port", str(ports[0])]
        return [*where, "--serve-web", "--web-viewer-port", str(ports[1])]

    with page_server(WEB_PORT) as (server, folder), _listening_program(options, LIVE_PORT, 0) as (process, ports):
        server.source_port = ports[0]
        server.take_over(ports[1], folder)
        address = _source(ports[0])
        page = server.page_url(address)
        yield LiveViewer(address=address, page=page, ports=(ports[0], server.port), process=process)


def _source(port: int) -> str:
    """The address that a recording connects to, and a page listens to."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


@contextlib.contextmanager
def headless(rrd: Path | None, width: int, height: int) -> Iterator[str]:
    """The address of a viewer without a window that has this .rrd open, or waits for a recording.

    It ends after ``LIFE_SECONDS`` whatever happens: what asks it something then gets an error instead of waiting.

    Raises:
        ViewerError: No graphics driver is there, or Rerun could not be started.
    """

    def options(ports: Sequence[int]) -> list[str]:
        shown = [] if rrd is None else [str(rrd)]
        size = f"{width}x{height}"
        where = ["--bind", LOOPBACK, "--port", str(ports[0])]
        return ["--headless", *where, "--hide-welcome-screen", "--window-size", size, *shown]

    with _listening_program(options, 0) as (process, (port,)):
        limit = threading.Timer(LIFE_SECONDS, _end, (process,))
        limit.daemon = True
        limit.start()
        try:
            yield _source(port)
        finally:
            limit.cancel()


@contextlib.contextmanager
def _listening_program(
    options: Callable[[Sequence[int]], Sequence[str]], *wanted: int
) -> Iterator[tuple[subprocess.Popen[bytes], list[int]]]:
    """Rerun running, and the ports that it listens on: the wanted ones where they are free.

    A port that was free may be taken by another program before Rerun has it; then others are tried.
    """
    for attempt in range(ATTEMPTS):
        ports = [_free_port(port if attempt == 0 else 0) for port in wanted]
        with _program(*options(ports)) as (process, log):
            if not all(_listens(port, process, log) for port in ports):
                if TAKEN in log.read_text(errors="replace") and attempt < ATTEMPTS - 1:
                    continue
                raise ViewerError(f"Rerun ended before it listened: {_reason(log)}")
            yield process, ports
            return


@contextlib.contextmanager
def _program(*options: str) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    """Rerun running, and the file that its messages go to."""
    with temporary_folder() as folder:
        log = folder / "log"
        with log.open("wb") as messages:
            process = subprocess.Popen(
                [sys.executable, "-m", "dmotion_bench.viewing.guard", *options],
                env={name: value for name, value in os.environ.items() if name.lower() not in PROXIES} | ENVIRONMENT,
                stdin=subprocess.PIPE,  # held open by this process for as long as it lives
                stdout=messages,
                stderr=messages,
                start_new_session=True,
            )
        try:
            yield process, log
        finally:
            _end(process)


def wait_for(process: subprocess.Popen[bytes]) -> int:
    """Wait until a program has ended; its exit code.

    A signal that comes right before ``waitpid``, or that the system hands to another thread, does not wake who waits
    there: Python would act upon it once the program has ended, which may be never.
    """
    while (code := process.poll()) is None:
        time.sleep(LOOK_SECONDS)
    return code


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the launcher and the viewer that it started, which may outlive it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5)
    end = time.monotonic() + 1
    with contextlib.suppress(ProcessLookupError, PermissionError):  # the latter from a group of zombies on macOS
        while time.monotonic() < end:
            os.killpg(process.pid, 0)
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5)
    if process.stdin is not None:
        process.stdin.close()


def _listens(port: int, process: subprocess.Popen[bytes], log: Path) -> bool:
    """Wait until the program listens on a port; False if it has ended before.

    It says so itself: that something answers there is no proof, it may be another program.
    """
    said = re.compile(rf"(Listening|Hosting).*{re.escape(f'{LOOPBACK}:{port}')}\b")
    end = time.monotonic() + START_SECONDS
    while time.monotonic() < end:
        if said.search(log.read_text(errors="replace")):
            return True
        if process.poll() is not None:
            return False
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
