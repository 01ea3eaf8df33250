"""A server that speaks S3 on the loopback address, and a proxy before it that spoils some of its answers."""

from __future__ import annotations

import http.client
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from dmotion_bench.storage import object_store

FAULTS = ("500", "503", "silent", "broken", "truncated", "short", "wrong")
BUCKET = "data"


@dataclass
class Storage:
    """What the proxy has seen, and what it is to spoil.

    Attributes:
        port: Of the proxy.
        seen: Method and path of each request.
        fault: Asked for each request by method and path: None, or one of ``FAULTS``.
        objects: The address of the bucket.
    """

    port: int
    seen: list[tuple[str, str]] = field(default_factory=list)
    fault: Callable[[str, str], str | None] = lambda _method, _path: None
    address: str = f"s3://{BUCKET}"
    _released: threading.Event = field(default_factory=threading.Event)

    @property
    def environment(self) -> dict[str, str]:
        """What points a client of S3 to this server."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}",
            "AWS_ACCESS_KEY_ID": "nobody",
            "AWS_SECRET_ACCESS_KEY": "nothing",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
        }

    def as_found(self, monkeypatch: pytest.MonkeyPatch, prefix: str, *, patience_s: float) -> Storage:
        """Itself, as a test finds it: a prefix of its own, no fault, short pauses, and so much patience.

        A busy machine takes a second for an answer, so only where the server is to be silent is there less patience.
        """
        for name, value in self.environment.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(object_store, "PATIENCE_S", patience_s)
        monkeypatch.setattr(object_store, "PAUSES", (0.001, 0.002, 0.004))
        self.address = f"s3://{BUCKET}/{prefix}"
        self.fault = lambda _method, _path: None
        self.seen.clear()
        return self

    def count(self, method: str, ending: str = "") -> int:
        """How many requests of this kind there were."""
        return sum(one == method and path.partition("?")[0].endswith(ending) for one, path in self.seen)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: Any

    def _pass_on(self) -> None:
        storage: Storage = self.server.storage
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        storage.seen.append((self.command, self.path))
        fault = storage.fault(self.command, self.path)
        if fault == "silent":
            storage._released.wait(30)
        if fault in ("silent", "broken"):
            self.close_connection = True
            return
        if fault in ("500", "503"):
            name = {"500": "InternalError", "503": "SlowDown"}[fault]
            self._answer(int(fault), f"<Error><Code>{name}</Code><Message>no</Message></Error>".encode(), {})
            return
        there = http.client.HTTPConnection("127.0.0.1", self.server.behind, timeout=30)
        there.request(self.command, self.path, body, dict(self.headers))
        answer = there.getresponse()
        content, headers = answer.read(), dict(answer.getheaders())
        there.close()
        if fault in ("wrong", "short"):  # of a storage that sends no checksums: ours must do
            headers = {name: value for name, value in headers.items() if "checksum" not in name.lower()}
        if fault == "wrong":
            content = bytes(byte ^ 0x55 for byte in content)
        if fault == "short":
            content = content[: len(content) // 2]
        self._answer(answer.status, content, headers, cut=len(content) // 2 if fault == "truncated" else 0)

    def _answer(self, status: int, content: bytes, headers: dict[str, str], cut: int = 0) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            if name.lower() not in ("content-length", "transfer-encoding", "connection", "content-range"):
                self.send_header(name, value)
        length = headers.get("Content-Length", "0") if self.command == "HEAD" else str(len(content))
        self.send_header("Content-Length", length)
        self.end_headers()
        self.wfile.write(content[: len(content) - cut])
        self.close_connection = self.close_connection or bool(cut)

    do_GET = do_PUT = do_HEAD = do_DELETE = do_POST = _pass_on  # noqa: N815

    def log_message(self, *given: object) -> None:
        """Say nothing."""


class _Proxy(ThreadingHTTPServer):
    def handle_error(self, *given: object) -> None:
        """A client that was killed has left; nobody need be told."""


@contextmanager
def object_storage() -> Iterator[Storage]:
    """A server with an empty bucket, reached through the proxy."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, behind = server.get_host_and_port()
    bucket = http.client.HTTPConnection("127.0.0.1", behind)
    bucket.request("PUT", f"/{BUCKET}")
    bucket.getresponse().read()
    bucket.close()
    proxy = _Proxy(("127.0.0.1", 0), _Handler)
    proxy.daemon_threads = True
    proxy.behind, proxy.storage = behind, Storage(proxy.server_address[1])  # type: ignore[attr-defined]
    thread = threading.Thread(target=proxy.serve_forever, daemon=True)
    thread.start()
    try:
        yield proxy.storage  # type: ignore[attr-defined]
    finally:
        proxy.storage._released.set()  # type: ignore[attr-defined]
        proxy.shutdown()
        proxy.server_close()
        server.stop()
