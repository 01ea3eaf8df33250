"""Rerun's web page, with the file that it shows, for this machine alone.

Rerun's own page asks other machines for fonts, for a newer version and for examples, and sends statistics of its use.
Here it is served with a content security policy [1] under which a browser lets it talk to this machine only. The page
itself is Rerun's, fetched from the program that comes with ``rerun-sdk``.

Rerun 0.41's own data server keeps a processor busy for as long as it runs once it has loaded a file (a third of a
core, measured, with nobody connected), and lets every program on the machine write into what is shown. So a file is
served from here, too.

[1] https://www.w3.org/TR/CSP3/
"""

from __future__ import annotations

import contextlib
import re
import shutil
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from urllib.parse import quote

from dmotion_bench.errors import ViewerError
from dmotion_bench.loopback_server import LOOPBACK, NAMES, PATIENCE_S, LoopbackServer, Served
from dmotion_bench.storage.temporary import temporary_folder

SCENE: Final = "/scene.rrd"
PAGE: Final = ("/", "/favicon.ico", "/re_viewer.js", "/re_viewer_bg.wasm")
"""All that Rerun's page consists of."""

_ELSEWHERE: Final = re.compile(rb"<link\b[^>]*\bhttps?://[^>]*>")
_POLICY: Final = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; connect-src 'self'"
)


class PageServer(LoopbackServer):
    """Serves the files of a page, and a scene.

    Args:
        port: 0 for a free one.

    Attributes:
        scene: The .rrd that the page shows; None where it listens to a recording.
        source_port: The port on this machine where it does so; 0 where it shows a scene.
        page: The page's files by their paths.

    Raises:
        OSError: The port is taken.
    """

    def __init__(self, port: int = 0) -> None:
        self.scene: Path | None = None
        self.source_port = 0
        self.page: dict[str, Served] = {}
        super().__init__(port)

    @property
    def scene_url(self) -> str:
        """The scene's address."""
        return f"http://{LOOPBACK}:{self.port}{SCENE}"

    def page_url(self, shown: str) -> str:
        """The address of the page that shows what is at another address."""
        return f"http://{LOOPBACK}:{self.port}?url={quote(shown, safe='')}"

    def find(self, path: str, origin: str) -> Served | None:
        """A file of the page, or the scene."""
        name, _, _ = path.partition("?")
        if name == SCENE and self.scene is not None:
            return Served(file=self.scene, kind="application/octet-stream", headers={"Cache-Control": "no-store"})
        return self.page.get(name)

    def take_over(self, port: int, folder: Path) -> None:
        """Serve a copy of the page that Rerun serves.

        Args:
            port: Of Rerun's server.
            folder: Where the copy lies.

        Raises:
            ViewerError: Rerun does not give it.
        """
        also = [f"http://{name}:{self.source_port}" for name in NAMES] if self.source_port else []
        policy = " ".join([_POLICY, *also])
        headers = {"Content-Security-Policy": policy, "Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}
        for number, path in enumerate(PAGE):
            copy = folder / f"{number}"
            try:
                with urllib.request.urlopen(f"http://{LOOPBACK}:{port}{path}", timeout=PATIENCE_S) as answer:
                    kind = answer.headers.get_content_type()
                    with copy.open("wb") as file:
                        shutil.copyfileobj(answer, file)
            except OSError as error:
                raise ViewerError(f"Rerun does not give its web page: {error}.") from None
            if path == "/":
                copy.write_bytes(_ELSEWHERE.sub(b"", copy.read_bytes()))
            self.page[path] = Served(file=copy, kind=kind, headers=headers)


@contextlib.contextmanager
def page_server(wanted: int) -> Iterator[tuple[PageServer, Path]]:
    """A server, and a folder for its page, for as long as the block lasts.

    Args:
        wanted: The port; another if it is taken.
    """
    try:
        server = PageServer(wanted)
    except OSError:
        server = PageServer()
    with server, temporary_folder() as folder:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server, folder
        finally:
            server.shutdown()
            thread.join()
