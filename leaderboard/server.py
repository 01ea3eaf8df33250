"""The leaderboard's folder over HTTP, for this machine alone: only the files that ``build`` writes, read only.

It listens on 127.0.0.1 and answers nobody who asks for it under another name, so that a page of the web which had
its name point here could not read it.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

from dmotion_bench.errors import UsageError
from leaderboard.layout import ENTRIES, PAGE, REFERENCES, SCHEMA

LOOPBACK: Final = "127.0.0.1"
_ENTRY: Final = re.compile(rf"/{ENTRIES}/((?:{REFERENCES}/)?[A-Za-z0-9_-]+\.json)")
_HTML, _JSON = "text/html; charset=utf-8", "application/json; charset=utf-8"


class LeaderboardServer(ThreadingHTTPServer):
    """Serves one folder.

    Args:
        folder: What ``build`` wrote.
        port: 0 for a free one.

    Raises:
        UsageError: There is no page in the folder, or the port is taken.
    """

    daemon_threads = True

    def __init__(self, folder: Path, port: int = 0) -> None:
        if not (folder / PAGE).is_file():
            raise UsageError(
                f"no leaderboard in {str(folder)!r}; make one with 'dmbench leaderboard build --out {folder}'."
            )
        self.folder = folder
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise UsageError(f"port {port} cannot be used: {error.strerror}; name another with '--port'.") from None

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

    def file(self, path: str) -> tuple[Path, str] | None:
        """The file and its type that a path stands for; None for any other path."""
        if path in ("/", f"/{PAGE}"):
            return self.folder / PAGE, _HTML
        if path == f"/{SCHEMA}":
            return self.folder / SCHEMA, _JSON
        entry = _ENTRY.fullmatch(path)
        return (self.folder / ENTRIES / entry[1], _JSON) if entry else None


class _Handler(BaseHTTPRequestHandler):
    server: LeaderboardServer

    def do_GET(self) -> None:
        file = self._head()
        if file is not None:
            with file.open("rb") as opened, contextlib.suppress(ConnectionError):
                shutil.copyfileobj(opened, self.wfile)

    def do_HEAD(self) -> None:
        self._head()

    def _head(self) -> Path | None:
        """Send status and headers; the file that follows, if any."""
        port = self.server.server_address[1]
        found = self.server.file(self.path.partition("?")[0])
        if self.headers.get("Host") not in (f"{LOOPBACK}:{port}", f"localhost:{port}") or found is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return None
        file, kind = found
        if not file.is_file() or not file.resolve().is_relative_to(self.server.folder.resolve()):
            self.send_error(HTTPStatus.NOT_FOUND)
            return None
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(file.stat().st_size))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-cache")
        self.end_headers()
        return file

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (http.server's naming)
        """Nobody reads a log of these requests."""
