"""Temporary folders go with their processes, or are taken away by the next one."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from dmotion_bench.storage import temporary
from dmotion_bench.storage.temporary import temporary_folder

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows deletes no folder in use, nor do we delete any there")

_HOLD = """
import sys
from dmotion_bench.storage.temporary import temporary_folder
with temporary_folder() as folder:
    (folder / "page").write_bytes(bytes(1000))
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where all temporary folders are made."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def other() -> Iterator[subprocess.Popen[str]]:
    """Another process with a folder, whose path it prints."""
    with subprocess.Popen([sys.executable, "-c", _HOLD], stdin=-1, stdout=-1, text=True) as process:
        yield process
        process.kill()


def folder_of(process: subprocess.Popen[str]) -> Path:
    assert process.stdout is not None
    return Path(process.stdout.readline().strip())


def test_a_folder_goes_with_its_block(place: Path) -> None:
    with temporary_folder() as folder:
        assert folder.parent == place
        assert folder.stat().st_mode & 0o777 == 0o700
        (folder / "inner").mkdir()
    assert list(place.iterdir()) == []


def test_what_a_killed_process_left_is_taken_away_and_what_a_living_one_has_is_not(
    place: Path, other: subprocess.Popen[str]
) -> None:
    left = folder_of(other)
    with temporary_folder() as own, temporary_folder():
        assert (left / "page").exists()
        assert own.exists()
        other.kill()
        other.wait()
        assert left.exists()
        with temporary_folder():
            assert not left.exists()
            assert own.exists()
    assert list(place.iterdir()) == []


def test_nothing_else_is_taken_away(place: Path, other: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody may write where temporary folders are made."""
    left = folder_of(other)
    other.kill()
    other.wait()
    shutil.copytree(left, place / "precious")
    (place / "dmbench-held-link").symlink_to(place / "precious")
    (place / "dmbench-held-of-an-earlier-version").mkdir()
    shutil.copytree(left, inner := place / "dmbench-held-with-a-link")
    (inner / "held").unlink()
    (inner / "held").symlink_to(place / "precious/held")
    (place / "dmbench-held-file").touch()
    os.mkfifo(place / "dmbench-held-pipe")
    before = {path for path in place.rglob("*") if not path.is_relative_to(left)}
    with monkeypatch.context() as patch:
        patch.setattr(os, "getuid", lambda: 4242)
        with temporary_folder():
            assert left.exists()
        patch.undo()
    with monkeypatch.context() as patch:
        patch.setattr(temporary.socket, "gethostname", lambda: "another-machine")
        with temporary_folder():
            assert left.exists()
    with temporary_folder():
        assert not left.exists()
    assert {*place.rglob("*")} == before


def test_a_disk_without_locks_keeps_everything(other: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch) -> None:
    left = folder_of(other)
    monkeypatch.setattr(temporary, "try_lock", lambda _handle: None)
    with temporary_folder():
        assert left.exists()
