"""The server gives what was built, to this machine alone, and nothing else."""

from __future__ import annotations

import http.client
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench import loopback_server
from dmotion_bench.errors import UsageError
from leaderboard.server import LeaderboardServer


@pytest.fixture
def server(tmp_path: Path) -> Iterator[LeaderboardServer]:
    folder = tmp_path / "board"
    (folder / "entries").mkdir(parents=True)
    (folder / "index.html").write_text("<p>page")
    (folder / "schema.json").write_text("{}")
    (folder / "entries/a-1.json").write_text('{"a": 1}')
    (folder / "notes.txt").write_text("private")
    (tmp_path / "secret.json").write_text("secret")
    with LeaderboardServer(folder) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def _get(server: LeaderboardServer, path: str, host: str | None = None) -> tuple[int, str, str]:
    port = server.server_address[1]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", host or f"127.0.0.1:{port}")
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, answer.getheader("Content-Type", ""), body


def test_it_listens_to_this_machine_alone(server: LeaderboardServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.url.startswith("http://127.0.0.1:")


def test_what_was_built_is_given(server: LeaderboardServer) -> None:
    assert _get(server, "/") == (200, "text/html; charset=utf-8", "<p>page")
    assert _get(server, "/index.html?x")[2] == "<p>page"
    assert _get(server, "/schema.json")[:2] == (200, "application/json; charset=utf-8")
    assert _get(server, "/entries/a-1.json")[2] == '{"a": 1}'


@pytest.mark.parametrize(
    "path",
    [
        *("/notes.txt", "/entries/", "/entries/none.json", "/../secret.json", "/entries/../../secret.json"),
        *("/entries/..%2f..%2fsecret.json", "//etc/passwd", "/entries/a-1.json/", "/%2e%2e/secret.json"),
    ],
)
def test_nothing_else_is(server: LeaderboardServer, path: str) -> None:
    status, _, body = _get(server, path)

    assert status == 404
    assert "secret" not in body.lower().replace("secret.json", "")


def test_a_link_out_of_the_folder_is_not_followed(server: LeaderboardServer, tmp_path: Path) -> None:
    (tmp_path / "secret.json").write_text('{"a": 1}')
    (server.folder / "entries" / "link.json").symlink_to(tmp_path / "secret.json")

    assert _get(server, "/entries/link.json")[0] == 404


def test_a_page_of_another_name_is_told_nothing(server: LeaderboardServer) -> None:
    assert _get(server, "/", host="evil.example")[0] == 404


def test_what_cannot_be_served_is_said(tmp_path: Path, server: LeaderboardServer) -> None:
    with pytest.raises(UsageError, match="leaderboard build"):
        LeaderboardServer(tmp_path)
    with pytest.raises(UsageError, match="--port"):
        LeaderboardServer(server.folder, server.server_address[1])


def _silent(server: LeaderboardServer, said: bytes) -> socket.socket:
    """A connection that says something and then nothing."""
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=30)
    connection.sendall(said)
    return connection


def _wait_until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\nHost: 127"])
def test_half_open_connections_make_room_for_others(
    server: LeaderboardServer, monkeypatch: pytest.MonkeyPatch, said: bytes
) -> None:
    monkeypatch.setattr(loopback_server, "MOST_CONNECTIONS", 3)
    silent = [_silent(server, said) for _ in range(5)]
    _wait_until(lambda: len(server._open) == 3)
    assert all(connection.recv(100) == b"" for connection in silent[:2])  # the oldest were closed
    assert _get(server, "/")[2] == "<p>page"
    for connection in silent:
        connection.close()
    _wait_until(lambda: not server._open)


def test_a_silent_connection_is_closed_after_a_while(
    server: LeaderboardServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loopback_server._Handler, "timeout", 0.1)
    with _silent(server, b"GET /") as connection:
        assert connection.recv(100) == b""
    _wait_until(lambda: not server._open)


def test_whoever_leaves_in_the_middle_is_no_error(server: LeaderboardServer, capfd: pytest.CaptureFixture[str]) -> None:
    (server.folder / "index.html").write_bytes(bytes(32 * 2**20))
    asked = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode()
    for said in (asked, b"GET /\x00 HTTP/9\r\n\r\n"):
        connection = _silent(server, said)
        assert connection.recv(10)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not a farewell
        connection.close()
    _wait_until(lambda: not server._open)
    assert capfd.readouterr() == ("", "")


def test_a_name_that_is_longer_than_any_file_s_is_not_found(server: LeaderboardServer) -> None:
    assert _get(server, f"/entries/{'a' * 300}.json")[0] == 404


def test_a_file_that_is_replaced_meanwhile_is_given_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page is built anew while it is served."""
    page, new = tmp_path / "page", tmp_path / "new"
    page.write_text("old")
    new.write_text("new, and longer")

    right = Path.open

    def replaced(self: Path, *args: Any, **more: Any) -> Any:
        new.replace(page)
        return right(self, *args, **more)

    monkeypatch.setattr(Path, "open", replaced)

    class Server(loopback_server.LoopbackServer):
        def find(self, path: str, origin: str) -> loopback_server.Served:
            return loopback_server.Served(file=page, kind="text/plain")

    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert (answer.getheader("Content-Length"), answer.read()) == ("15", b"new, and longer")
        connection.close()
        server.shutdown()
        thread.join()
