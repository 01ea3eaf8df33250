"""A folder's lock: one holder, none after its process is gone, no trace in the folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from filelock import lock_descriptor

from dmotion_bench.errors import FolderInUse
from dmotion_bench.storage import lock
from dmotion_bench.storage.lock import FolderLock, held

HOLD = """
import sys, time
from pathlib import Path
from dmotion_bench.storage import lock
lock.OPENS_FOLDERS = {opens}
kept = lock.FolderLock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""
each_system = pytest.mark.parametrize("opens", [True, False], ids=["POSIX", "as on Windows"])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "d").mkdir()
    return tmp_path / "d"


@each_system
def test_a_killed_process_holds_no_lock(folder: Path, opens: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "OPENS_FOLDERS", opens)
    with subprocess.Popen(
        [sys.executable, "-c", HOLD.format(opens=opens), folder], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        said = process.stdout.readline()
        try:
            with pytest.raises(
                FolderInUse, match=rf"another dmbench is writing into '{folder}'; wait for it, or not\."
            ):
                FolderLock(folder, ", or not")
        finally:
            process.kill()
    assert said == "held\n"
    with held(folder):
        pass


@each_system
def test_a_lock_leaves_nothing_and_needs_no_writable_folder(
    folder: Path, opens: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "OPENS_FOLDERS", opens)
    (folder / "file").write_text("data")
    folder.chmod(0o555)
    before = folder.stat()
    with held(folder), pytest.raises(FolderInUse):
        FolderLock(folder)
    assert list(folder.parent.rglob("*")) == [folder, folder / "file"]
    assert folder.stat().st_mtime_ns == before.st_mtime_ns
    folder.chmod(0o755)


@each_system
def test_a_folder_that_replaced_the_locked_one_is_told_from_it(
    folder: Path, opens: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "OPENS_FOLDERS", opens)
    lock_on = FolderLock(folder)
    assert lock_on.is_on(folder)
    folder.rename(folder.with_name("moved"))
    with pytest.raises(FileNotFoundError):
        lock_on.is_on(folder)
    folder.mkdir()
    assert not lock_on.is_on(folder)
    assert lock_on.is_on(folder.with_name("moved"))
    lock_on.release()
    lock_on.release()


def test_the_lock_is_the_one_of_filelock_and_of_earlier_versions(folder: Path) -> None:
    """So that two versions of dmbench, whoever wrote the lock, do not share a folder."""
    import fcntl
    import os

    handle = os.open(folder, os.O_RDONLY)
    with held(folder):
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert not lock_descriptor(handle, blocking=False)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with pytest.raises(FolderInUse):
        FolderLock(folder)
    os.close(handle)


def test_a_file_system_without_locks_is_used_all_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(_handle: int, *, blocking: bool) -> bool:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(lock, "lock_descriptor", no_locks)
    with held(folder), held(folder):
        pass
