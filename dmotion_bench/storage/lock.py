"""One writer a folder: a lock that the system lets go of however the process ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from dmotion_bench.errors import FolderInUse


def lock_folder(path: Path) -> int:
    """Hold a folder until the descriptor that is returned is closed.

    Raises:
        FolderInUse: Somebody else holds it.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise FolderInUse(f"another dmbench is writing into {str(path)!r}; wait for it to end.") from None
    except OSError:
        pass  # a file system without locks: what is written is atomic in any case
    return handle


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Nobody else writes into the folder meanwhile.

    Raises:
        FolderInUse: Somebody else does.
    """
    lock = lock_folder(path)
    try:
        yield
    finally:
        os.close(lock)
