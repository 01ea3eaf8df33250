"""A folder's lock: one holder, none after its process is gone, no trace in the folder or beside it."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from filelock import lock_descriptor

from dmotion_bench.errors import FolderInUse
from dmotion_bench.storage import lock
from dmotion_bench.storage.atomic import remove_leftovers
from dmotion_bench.storage.lock import FolderLock, held, in_turn

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
    assert (folder.parent / ".d.lock").exists()
    with held(folder):
        pass
    assert list(folder.parent.iterdir()) == [folder]


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
    handle = os.open(folder, os.O_RDONLY)
    with held(folder):
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert not lock_descriptor(handle, blocking=False)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with pytest.raises(FolderInUse):
        FolderLock(folder)
    os.close(handle)


def by_nfs(handle: int, *, blocking: bool) -> bool:
    """Locks as NFS gives them: only on what is open for writing."""
    if fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, "Bad file descriptor")
    return lock_descriptor(handle, blocking=blocking)


def test_two_machines_that_share_a_disk_by_nfs_do_not_share_a_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(lock, "lock_descriptor", by_nfs)
    (folder.parent / "link").symlink_to(folder)
    with held(folder):
        for name in ("d", "link"):
            with pytest.raises(FolderInUse):
                FolderLock(folder.parent / name)
    with held(folder):
        pass
    (folder / "x.0123abcd.part").touch()
    remove_leftovers(folder)
    assert not list(folder.iterdir())
    assert not caplog.records


def test_a_lock_file_that_its_holder_deletes_is_made_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    try_lock, first = lock.try_lock, FolderLock(folder)

    def late(handle: int) -> bool | None:
        first.release()  # after the file was opened
        return try_lock(handle)

    monkeypatch.setattr(lock, "OPENS_FOLDERS", False)  # so that only the file is locked
    monkeypatch.setattr(lock, "try_lock", late)
    with held(folder), pytest.raises(FolderInUse):
        FolderLock(folder)


def test_where_no_file_can_be_made_beside_it_the_folder_alone_is_locked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def read_only(self: object) -> bool:
        raise PermissionError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("dmotion_bench.storage.lock._LockFile.acquire", read_only)
    with held(folder), pytest.raises(FolderInUse):
        FolderLock(folder)
    with in_turn(folder / "x"):
        pass
    assert not caplog.records


def test_a_link_in_the_lock_s_place_makes_no_file_elsewhere(folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    for name in (".d.lock", ".x.lock"):
        (folder.parent / name).symlink_to(elsewhere)
    with held(folder), in_turn(folder.parent / "x"), pytest.raises(FolderInUse):
        FolderLock(folder)
    assert not elsewhere.exists()


def test_who_makes_the_same_file_is_waited_for(folder: Path) -> None:
    order = []

    def make() -> None:
        with in_turn(folder / "x"):
            order.append("second")

    second = threading.Thread(target=make)
    with in_turn(folder / "x"):
        second.start()
        second.join(0.3)
        order.append("first")
    second.join()
    assert order == ["first", "second"]
    assert not list(folder.iterdir())


def test_a_file_system_without_locks_is_used_all_the_same_and_named_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_locks(_handle: int, *, blocking: bool) -> bool:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(lock, "lock_descriptor", no_locks)
    with held(folder), held(folder):
        pass
    (said,) = caplog.messages
    assert said.startswith(f"the disk of '{folder.parent}' knows no locks")
    assert list(folder.parent.iterdir()) == [folder]
