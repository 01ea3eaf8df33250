"""A disk that can no longer read some bytes of a file."""

from __future__ import annotations

import contextlib
import errno
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


class _Flawed(io.FileIO):
    """A file that is read up to the bad bytes, and from after them on."""

    def __init__(self, path: Path, bad: range) -> None:
        super().__init__(path)
        self._bad = bad

    def readinto(self, buffer: Any) -> int:
        start, view = self.tell(), memoryview(buffer).cast("B")
        if start in self._bad:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if start < self._bad.start:
            view = view[: self._bad.start - start]
        return super().readinto(view)


@contextlib.contextmanager
def lost(file: Path, bad: range) -> Iterator[None]:
    """These bytes of a file are unreadable wherever ``Path.open`` opens it, also after it was renamed."""
    number, sound = file.stat().st_ino, Path.open

    def opened(path: Path, mode: str = "r", *given: Any, **named: Any) -> Any:
        if mode == "rb" and path.stat().st_ino == number:
            return io.BufferedReader(_Flawed(path, bad))
        return sound(path, mode, *given, **named)

    with file.open("rb"), pytest.MonkeyPatch.context() as patch:  # open, so that no other file gets its number
        patch.setattr(Path, "open", opened)
        yield
