"""Pointers of Git LFS: what a clone holds in place of large files until ``git lfs pull`` fetches them."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Final

from dmotion_bench.errors import RecordingImportError, RecordingNotFetched

IS_POINTER: Final = "is a pointer of Git LFS and not the file itself; fetch the files with 'git lfs pull'"
_START: Final = b"version https://git-lfs"


def is_pointer(start: bytes) -> bool:
    """Whether a file is a pointer, by its beginning."""
    return start.startswith(_START)


def require_content(file: Path) -> None:
    """Check that a file is not a pointer, nor a pipe; whoever reads it says what else is wrong with it.

    Raises:
        RecordingNotFetched: It is a pointer.
        RecordingImportError: It would be waited for.
    """
    try:
        if not stat.S_ISREG(file.stat().st_mode):
            raise RecordingImportError(f"{str(file)!r} is no ordinary file.")
        with file.open("rb") as opened:
            start = opened.read(len(_START))
    except OSError:
        return
    if is_pointer(start):
        raise RecordingNotFetched(f"{str(file)!r} {IS_POINTER}.")
