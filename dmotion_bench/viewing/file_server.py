"""One file over HTTP, to this machine alone: what Rerun's web page fetches its data from.

Rerun 0.41's own data server keeps a processor busy for as long as it runs once it has loaded a file (a third of a
core, measured, with nobody connected), and lets every program on the machine write into what is shown.
"""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

LOOPBACK = "127.0.0.1"
NAMES = (LOOPBACK, "localhost")


class FileServer(ThreadingHTTPServer):
    """Answers for one path.

    Attributes:
        file: What it gives.
        page_port: Pages of this port, on this machine, may read it; others may not, of no port nobody.
    """

    daemon_threads = True

    def __init__(self, file: Path, page_port: int = 0) -> None:
        self.file, self.page_port = file, page_port
        super().__init__((LOOPBACK, 0), _Handler)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        """The file's address."""
        return f"http://{LOOPBACK}:{self.port}/scene.rrd"


class _Handler(BaseHTTPRequestHandler):
    server: FileServer

    def do_GET(self) -> None:
        if self._head():
            with self.server.file.open("rb") as file, contextlib.suppress(ConnectionError):
                shutil.copyfileobj(file, self.wfile)

    def do_HEAD(self) -> None:
        self._head()

    def _head(self) -> bool:
        """The status and headers; whether the file follows."""
        here = {f"{name}:{self.server.port}" for name in NAMES}  # a page of another name is no page of this machine
        if self.path != "/scene.rrd" or self.headers.get("Host") not in here:
            self.send_error(HTTPStatus.NOT_FOUND)
            return False
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Content-Length", str(self.server.file.stat().st_size))
        self.send_header("Cache-Control", "no-store")
        origin = self.headers.get("Origin", "")
        if origin in {f"http://{name}:{self.server.page_port}" for name in NAMES}:
            self.send_header("Access-Control-Allow-Origin", origin)
        self.end_headers()
        return True

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (http.server's naming)
        """Nobody reads a log of these requests."""


@contextlib.contextmanager
def serving(file: Path, page_port: int = 0) -> Iterator[FileServer]:
    """A server of one file for as long as the block lasts."""
    with FileServer(file, page_port) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
