"""Locks for folders with one writer; the operating system releases them when a process ends, however it ends.

A folder is locked twice. The lock on the folder itself needs nothing that can be written, holds on one machine, and is
that of earlier versions. The lock on a regular file beside it, opened for reading and writing, also holds between
machines that share the disk: by NFS an exclusive lock needs a file that may be written (flock(2)).
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from filelock import lock_descriptor

from dmotion_bench.errors import FolderInUse
from dmotion_bench.wording import shown

ANOTHER_FOLDER: Final = ", or name another folder with '--out DIR'"
"""The way out of what is told where to write."""
OPENS_FOLDERS: Final = os.name != "nt"
"""Whether a folder can be opened like a file. Windows cannot: there only the file beside the folder is locked."""
NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0)
"""A link in a folder that came from somebody else would make the file that is locked anywhere."""
_PAUSE_S: Final = 0.1
_log = logging.getLogger(__name__)


class FolderLock:
    """An exclusive lock on a folder, held until ``release``, or until the process ends.

    It leaves no file in the folder, which need not be writable. While it is held, ``.NAME.lock`` stands beside the
    folder, if a file can be made there. A killed process leaves that empty file; who locks the folder next deletes it.

    Args:
        path: The folder.
        way_out: What else than waiting helps where it is held already, for the sentence that says so.

    Raises:
        FolderInUse: Somebody else holds it.
    """

    def __init__(self, path: Path, way_out: str = "") -> None:
        self._folder = path.stat()
        self._handle: int | None = None
        whole = path.resolve()
        self._file = _LockFile(lock_beside(whole)) if whole.name else None
        locked: bool | None = None
        if OPENS_FOLDERS:
            self._handle = os.open(path, os.O_RDONLY)
            self._folder = os.fstat(self._handle)  # not of the path, which may be another folder already
            locked = try_lock(self._handle)
        if locked is not False and self._file is not None:
            with contextlib.suppress(OSError):  # no file can be made there
                locked = self._file.acquire()
        if locked is False:
            self.release()
            raise FolderInUse(f"another dmbench is writing into {str(path)!r}; wait for it{way_out}.")
        if locked is None:
            _warn_of_no_locks(path.parent)

    def is_on(self, path: Path) -> bool:
        """Whether the folder of this name is the one that was locked, not one that has replaced it.

        Raises:
            FileNotFoundError: There is none.
        """
        return os.path.samestat(path.stat(), self._folder)

    def release(self) -> None:
        """Let others lock the folder; a second call does nothing."""
        if self._file is not None:
            self._file.release()
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None


def lock_beside(path: Path) -> Path:
    """The file that is locked for a folder, or for a file that is being made."""
    return path.with_name(f".{path.name}.lock")


class _LockFile:
    """A file that is there to be locked, and is deleted when it is released."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle: int | None = None

    def acquire(self) -> bool | None:
        """Lock the file, without waiting.

        Returns:
            Whether it is locked by this call; None on a file system without locks.

        Raises:
            OSError: It can be neither made nor opened.
        """
        while True:
            handle = os.open(self.path, os.O_RDWR | os.O_CREAT | NO_LINK, 0o666)
            locked = try_lock(handle)
            if locked is False:
                os.close(handle)
                return False
            if _has_name(handle, self.path):
                self._handle = handle
                return locked
            os.close(handle)  # whoever held it has just deleted it

    def release(self) -> None:
        """Delete the file and let others lock it; does nothing where it is not held."""
        if self._handle is None:
            return
        if OPENS_FOLDERS:  # still locked, so that it is nobody else's
            self.path.unlink(missing_ok=True)
        os.close(self._handle)
        self._handle = None
        if not OPENS_FOLDERS:
            with contextlib.suppress(OSError):  # Windows keeps what somebody else has opened meanwhile
                self.path.unlink()


def _has_name(handle: int, path: Path) -> bool:
    """Whether an open file is the one of that name."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except OSError:  # there is none; by NFS the open one may be gone, too
        return False


def try_lock(handle: int) -> bool | None:
    """Lock an open file, without waiting.

    Args:
        handle: Its descriptor, open for writing where the lock is to hold between machines; the lock is on it until it
            is closed.

    Returns:
        Whether the file is locked by this call; None on a file system without locks.
    """
    try:
        return lock_descriptor(handle, blocking=False)
    except OSError:  # what is written is atomic in any case
        return None


@functools.cache
def _warn_of_no_locks(folder: Path) -> None:
    """Say so once for each folder."""
    _log.warning(
        "the disk of %s knows no locks, so dmbench cannot notice another one that writes there; let only one command "
        "at a time write into a folder.",
        shown(str(folder)),
    )


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on the folder within the block.

    Raises:
        FolderInUse: Somebody else does.
    """
    lock = FolderLock(path)
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def in_turn(path: Path) -> Iterator[None]:
    """Hold the lock for making a file within the block; another process that makes the same file is waited for.

    Where the folder can take no file nobody is waited for, and what is made there fails of itself.
    """
    file = _LockFile(lock_beside(path))
    with contextlib.suppress(OSError):
        if (locked := file.acquire()) is False:
            _log.info("waiting for another dmbench, which is making %s.", shown(str(path)))
        while locked is False:
            time.sleep(_PAUSE_S)
            locked = file.acquire()
        if locked is None:
            _warn_of_no_locks(path.parent)
    try:
        yield
    finally:
        file.release()
