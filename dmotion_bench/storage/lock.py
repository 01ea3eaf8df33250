"""One writer a folder: a lock that the system lets go of however the process ends."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from dmotion_bench.errors import DatasetError


def lock_folder(path: Path) -> int:
    """Hold a data set's folder until the descriptor that is returned is closed."""
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise DatasetError(
            f"another dmbench is writing into {str(path)!r}; wait for it, or name another folder with '--out DIR'."
        ) from None
    except OSError:
        pass  # a file system without locks: what is written is atomic in any case
    return handle
