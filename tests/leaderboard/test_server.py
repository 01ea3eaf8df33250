"""The server gives what was built, to this machine alone, and nothing else."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

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
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
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
