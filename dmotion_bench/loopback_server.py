"""Files over HTTP to this machine alone, whatever the other side does.

It listens on 127.0.0.1 and answers nobody who asks for it under another name, so that a page of the web which had its
name point here could not read it. Connections that say nothing, or speak slowly, are closed: each after a while, the
oldest when there are too many.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

LOOPBACK: Final = "127.0.0.1"
NAMES: Final = (LOOPBACK, "localhost")
PATIENCE_S: Final = 15.0
"""That the other side may be silent."""
MOST_CONNECTIONS: Final = 32


@dataclass(frozen=True, kw_only=True)
class Served:
    """A file to be given.

    Attributes:
        file: The file.
        kind: Its type, as HTTP says it.
        headers: What else is said.
    """

    file: Path
    kind: str
    headers: Mapping[str, str] = field(default_factory=dict)


class LoopbackServer(ThreadingHTTPServer):
    """Gives the files that ``find`` names.

    Args:
        port: 0 for a free one.

    Raises:
        OSError: The port is taken.
    """

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        self._open: dict[socket.socket, None] = {}  # in the order in which they came
        self._changing = threading.Lock()
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.server_address[1])

    def find(self, path: str, origin: str) -> Served | None:
        """The file that a path stands for; None for a path that stands for none.

        Args:
            path: As the other side has it, with its query.
            origin: The page that asks, ``""`` if none does.
        """
        raise NotImplementedError

    def process_request(self, request: Any, client_address: Any) -> None:
        """Make room for a connection, and answer it in a thread of its own."""
        with self._changing:
            self._open[request] = None
            excess = [*self._open][:-MOST_CONNECTIONS]
            for oldest in excess:
                del self._open[oldest]
        for oldest in excess:
            with contextlib.suppress(OSError):  # its thread may just have closed it
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Forget a connection that is being closed."""
        with self._changing:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Whoever goes away in the middle is no error."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: LoopbackServer
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        found = self._head()
        if found is not None:
            with found.file.open("rb") as file:
                shutil.copyfileobj(file, self.wfile)

    def do_HEAD(self) -> None:
        self._head()

    def _head(self) -> Served | None:
        """Send status and headers; the file that follows, if any."""
        here = {f"{name}:{self.server.port}" for name in NAMES}
        known = self.headers.get("Host") in here
        found = self.server.find(self.path, self.headers.get("Origin", "")) if known else None
        if found is None or not found.file.is_file():
            self.send_error(HTTPStatus.NOT_FOUND)
            return None
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", found.kind)
        self.send_header("Content-Length", str(found.file.stat().st_size))
        for name, value in found.headers.items():
            self.send_header(name, value)
        self.end_headers()
        return found

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (http.server's naming)
        """Nobody reads a log of these requests."""
