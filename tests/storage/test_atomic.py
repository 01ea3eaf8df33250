"""Temporary files: whose process was killed is deleted, whose process still writes is not."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from dmotion_bench.storage import atomic, lock
from dmotion_bench.storage.atomic import TEMPORARY_SUFFIX, atomic_file, is_unused, remove_leftovers


def no_locks(_handle: int, *, blocking: bool) -> bool:
    raise OSError(38, "Function not implemented")


def _killed_while_writing(path: Path) -> None:
    process = os.fork()
    if process == 0:
        with atomic_file(path) as file:
            file.write(b"half")
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(process, 0)


def test_only_what_nobody_writes_any_more_is_deleted(tmp_path: Path) -> None:
    _killed_while_writing(tmp_path / "dead")
    assert [path.suffix for path in tmp_path.iterdir()] == [TEMPORARY_SUFFIX]
    (tmp_path / "folder.0123abcd.part").mkdir()
    (tmp_path / "film.mp4.part").write_bytes(b"of another program")
    with atomic_file(tmp_path / "alive") as file:
        file.write(b"whole")
        remove_leftovers(tmp_path)
        (temporary,) = tmp_path.glob("alive.*.part")
        assert temporary.is_file()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alive", "film.mp4.part", "folder.0123abcd.part"]
    assert (tmp_path / "alive").read_bytes() == b"whole"


def test_a_folder_is_unused_until_something_is_finished_in_it(tmp_path: Path) -> None:
    assert is_unused(tmp_path / "missing")
    assert is_unused(tmp_path)
    _killed_while_writing(tmp_path / "dead")
    assert is_unused(tmp_path)
    (tmp_path / "film.mp4.part").touch()  # of another program: it is neither ignored nor deleted
    assert not is_unused(tmp_path)


def test_a_file_that_is_taken_for_a_leftover_before_it_is_locked_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try_lock, taken = atomic.try_lock, []

    def late(handle: int) -> bool | None:
        if not taken:
            taken.extend(tmp_path.glob("*.part"))
            taken[0].unlink()
        return try_lock(handle)

    monkeypatch.setattr(atomic, "try_lock", late)
    with atomic_file(tmp_path / "x") as file:
        file.write(b"whole")
    assert len(taken) == 1
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("x", b"whole")]


def test_without_locks_files_are_written_and_leftovers_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on some network file systems, where nobody can tell a leftover from a file that is being written."""

    monkeypatch.setattr(lock, "lock_descriptor", no_locks)
    (tmp_path / f"x.00000001{TEMPORARY_SUFFIX}").touch()
    with atomic_file(tmp_path / "x") as file:
        file.write(b"whole")
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x", f"x.00000001{TEMPORARY_SUFFIX}"]


def test_where_folders_cannot_be_opened_files_are_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, which also renames and deletes no file that is open."""
    monkeypatch.setattr(atomic, "OPENS_FOLDERS", False)
    rename = Path.replace

    def closed_only(source: Path, target: Path) -> Path:
        assert source not in [open_file.resolve() for open_file in Path("/proc/self/fd").iterdir()]
        return rename(source, target)

    monkeypatch.setattr(Path, "replace", closed_only)
    (tmp_path / f"x.00000001{TEMPORARY_SUFFIX}").touch()
    with atomic_file(tmp_path / "x") as file:
        file.write(b"whole")
    remove_leftovers(tmp_path)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("x", b"whole")]
