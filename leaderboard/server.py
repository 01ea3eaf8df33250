"""An HTTP server of the leaderboard's folder for this machine alone; it serves only the files that ``build`` writes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from dmotion_bench.errors import UsageError
from dmotion_bench.loopback_server import LOOPBACK, LoopbackServer, Served
from dmotion_bench.wording import command
from leaderboard.layout import ENTRIES, PAGE, REFERENCES, SCHEMA

_ENTRY: Final = re.compile(rf"/{ENTRIES}/((?:{REFERENCES}/)?[A-Za-z0-9_-]{{1,200}}\.json)")
_HTML, _JSON = "text/html; charset=utf-8", "application/json; charset=utf-8"
_HEADERS: Final = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-cache"}


class LeaderboardServer(LoopbackServer):
    """Serves one folder.

    Args:
        folder: What ``build`` wrote.
        port: 0 for a free one.

    Raises:
        UsageError: There is no page in the folder, or the port is taken.
    """

    def __init__(self, folder: Path, port: int = 0) -> None:
        if not (folder / PAGE).is_file():
            build = command("dmbench leaderboard build --out", folder)
            raise UsageError(f"no leaderboard in {str(folder)!r}; make one with {build}.")
        self.folder = folder
        try:
            super().__init__(port)
        except OSError as error:
            raise UsageError(f"port {port} cannot be used: {error.strerror}; name another with '--port'.") from None

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http://{LOOPBACK}:{self.port}/"

    def find(self, path: str, origin: str) -> Served | None:
        """Find the page, the schema or an entry; nothing outside of the folder is served."""
        name, kind = self._name(path.partition("?")[0])
        file = self.folder / name
        if not name or not file.resolve().is_relative_to(self.folder.resolve()):
            return None
        return Served(file=file, kind=kind, headers=_HEADERS)

    @staticmethod
    def _name(path: str) -> tuple[str, str]:
        """The file's place in the folder and its type; no place for any other path."""
        if path in ("/", f"/{PAGE}"):
            return PAGE, _HTML
        if path == f"/{SCHEMA}":
            return SCHEMA, _JSON
        entry = _ENTRY.fullmatch(path)
        return (f"{ENTRIES}/{entry[1]}", _JSON) if entry else ("", "")
