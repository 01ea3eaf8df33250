"""An HTTP server of one file for this machine alone, from which Rerun's web page loads its data.

Rerun 0.41's own data server keeps a processor busy for as long as it runs once it has loaded a file (a third of a
core, measured, with nobody connected), and lets every program on the machine write into what is shown.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

from dmotion_bench.loopback_server import LOOPBACK, NAMES, LoopbackServer, Served


class FileServer(LoopbackServer):
    """Serves one path.

    Attributes:
        file: What it gives.
        page_port: Pages of this port, on this machine, may read it; others may not, of no port nobody.
    """

    def __init__(self, file: Path, page_port: int = 0) -> None:
        self.file, self.page_port = file, page_port
        super().__init__()

    @property
    def url(self) -> str:
        """The file's address."""
        return f"http://{LOOPBACK}:{self.port}/scene.rrd"

    def find(self, path: str, origin: str) -> Served | None:
        """The file, if the path is its name."""
        if path != "/scene.rrd":
            return None
        pages = {f"http://{name}:{self.page_port}" for name in NAMES}
        allowed = {"Access-Control-Allow-Origin": origin} if origin in pages else {}
        headers = {"Cache-Control": "no-store", **allowed}
        return Served(file=self.file, kind="application/octet-stream", headers=headers)


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
