"""Locks for folders with one writer; the operating system releases them when a process ends, however it ends."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from filelock import lock_descriptor

from dmotion_bench.errors import FolderInUse

ANOTHER_FOLDER: Final = ", or name another folder with '--out DIR'"
"""The way out of what is told where to write."""
OPENS_FOLDERS: Final = os.name != "nt"
"""Whether a folder can be opened like a file. Windows cannot: there the lock is on a file beside the folder."""


class FolderLock:
    """An exclusive lock on a folder, held until ``release``, or until the process ends.

    It leaves no file in the folder, which need not be writable.

    Args:
        path: The folder.
        way_out: What else than waiting helps where it is held already, for the sentence that says so.

    Raises:
        FolderInUse: Somebody else holds it.
    """

    def __init__(self, path: Path, way_out: str = "") -> None:
        self._beside = None if OPENS_FOLDERS else path.absolute().with_name(f"{path.absolute().name}.lock")
        if self._beside is None:
            self._handle: int | None = os.open(path, os.O_RDONLY)
            self._folder = os.fstat(self._handle)  # not of the path, which may be another folder already
        else:
            self._folder = path.stat()
            self._handle = os.open(self._beside, os.O_RDWR | os.O_CREAT)
        if try_lock(self._handle) is False:
            os.close(self._handle)
            raise FolderInUse(f"another dmbench is writing into {str(path)!r}; wait for it{way_out}.")

    def is_on(self, path: Path) -> bool:
        """Whether the folder of this name is the one that was locked, not one that has replaced it.

        Raises:
            FileNotFoundError: There is none.
        """
        return os.path.samestat(path.stat(), self._folder)

    def release(self) -> None:
        """Let others lock the folder; a second call does nothing."""
        if self._handle is None:
            return
        os.close(self._handle)
        self._handle = None
        if self._beside is not None:
            with contextlib.suppress(OSError):  # Windows keeps what somebody else has opened meanwhile
                self._beside.unlink()


def try_lock(handle: int) -> bool | None:
    """Lock an open file, without waiting.

    Args:
        handle: Its descriptor; the lock is on it until it is closed.

    Returns:
        Whether the file is locked by this call; None on a file system without locks.
    """
    try:
        return lock_descriptor(handle, blocking=False)
    except OSError:  # what is written is atomic in any case
        return None


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
