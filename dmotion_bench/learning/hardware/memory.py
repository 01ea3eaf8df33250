"""How the C library treats memory that is freed."""

from __future__ import annotations

import contextlib
import ctypes

M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # malloc.h of the GNU C library


def keep_freed_memory() -> None:
    """Let the C library keep what a step of training, scoring or planning frees for the next one.

    Page faults on fresh memory cost a fifth of a training step. Only the GNU C library can do this.
    """
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        library.mallopt(M_TRIM_THRESHOLD, (1 << 31) - 1)
