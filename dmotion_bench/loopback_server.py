"""An HTTP server for this machine alone, safe with misbehaving clients.

It listens on 127.0.0.1 and answers nobody who asks for it under another name, so that a page of the web which had its
name point here could not read it. Connections that say nothing, or speak slowly, are closed: each after a while, the
oldest when there are too many.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO, Any, Final

LOOPBACK: Final = "127.0.0.1"
NAMES: Final = (LOOPBACK, "localhost")
PATIENCE_S: Final = 15.0
"""That the other side may be silent."""
MOST_CONNECTIONS: Final = 32


@dataclass(frozen=True, kw_only=True)
class Served:
    """A file to send.

    Attributes:
        file: The file.
        kind: Its type, as HTTP says it.
        headers: What else is said.
    """

    file: Path
    kind: str
    headers: Mapping[str, str] = field(default_factory=dict)


class LoopbackServer(ThreadingHTTPServer):
    """Serves the files that ``find`` returns.

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
        """The port that the server listens on."""
        return int(self.server_address[1])

    def find(self, path: str, origin: str) -> Served | None:
        """The file that a path stands for; None for a path that stands for none.

        Args:
            path: As the other side has it, with its query.
            origin: The page that asks, ``""`` if none does.
        """
        raise NotImplementedError

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread of its own; close the oldest connection if there are too many."""
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
        """Ignore clients that disconnect early."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: LoopbackServer
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        with self._head() as file:
            if file is not None:
                shutil.copyfileobj(file, self.wfile)

    def do_HEAD(self) -> None:
        with self._head():
            pass

    @contextlib.contextmanager
    def _head(self) -> Iterator[IO[bytes] | None]:
        """Send status and headers; the file that follows, if any.

        It is open before its size is said, since another may take its name at any moment.
        """
        here = {f"{name}:{self.server.port}" for name in NAMES}
        known = self.headers.get("Host") in here
        found = self.server.find(self.path, self.headers.get("Origin", "")) if known else None
        with contextlib.ExitStack() as stack:
            try:
                is_there = found is not None and found.file.is_file()  # a pipe would be waited for
                file = stack.enter_context(found.file.open("rb")) if found is not None and is_there else None
            except OSError:  # it may not be read, or is gone meanwhile
                file = None
            if found is None or file is None:
                self.send_error(HTTPStatus.NOT_FOUND)
                yield None
                return
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", found.kind)
            self.send_header("Content-Length", str(os.fstat(file.fileno()).st_size))
            for name, value in found.headers.items():
                self.send_header(name, value)
            self.end_headers()
            yield file

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (http.server's naming)
        """Write no log of requests."""
