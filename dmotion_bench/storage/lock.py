"""Locks for folders with one writer; the operating system releases them when a process ends, however it ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from dmotion_bench.errors import FolderInUse

ANOTHER_FOLDER: Final = ", or name another folder with '--out DIR'"
"""The way out of what is told where to write."""


def lock_folder(path: Path, way_out: str = "") -> int:
    """Hold a folder until the descriptor that is returned is closed.

    Args:
        path: The folder.
        way_out: What else than waiting helps where it is held already, for the sentence that says so.

    Raises:
        FolderInUse: Somebody else holds it.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise FolderInUse(f"another dmbench is writing into {str(path)!r}; wait for it{way_out}.") from None
    except OSError:
        pass  # a file system without locks: what is written is atomic in any case
    return handle


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on the folder within the block.

    Raises:
        FolderInUse: Somebody else does.
    """
    lock = lock_folder(path)
    try:
        yield
    finally:
        os.close(lock)
