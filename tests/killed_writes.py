"""A process that is killed while it writes files, at every moment at which the disk can look different."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest


class Killed(BaseException):
    """The end of a process; nothing that it would tidy up is tidied up."""


@contextlib.contextmanager
def killed_at(moment: int) -> Iterator[None]:
    """End the block at its n-th sync or rename, before that happens, and leave the files as a kill would."""
    passed = 0
    fsync, rename, unlink = os.fsync, Path.replace, Path.unlink

    def reach() -> None:
        nonlocal passed
        passed += 1
        if passed > moment:
            raise Killed

    def sync(handle: int) -> None:
        reach()
        fsync(handle)

    def replace(path: Path, target: Path) -> Path:
        reach()
        return rename(path, target)

    def delete(path: Path, missing_ok: bool = False) -> None:
        if passed <= moment:
            unlink(path, missing_ok)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        patch.setattr(Path, "replace", replace)
        patch.setattr(Path, "unlink", delete)
        yield


def each_kill(work: Callable[[int], object]) -> Iterator[int]:
    """Do a work again and again, killed at a later moment each time, until it comes to its end.

    Args:
        work: Given the number of the moment.

    Yields:
        That number, after each kill.
    """
    for moment in itertools.count():
        try:
            with killed_at(moment):
                work(moment)
        except Killed:
            yield moment
        else:
            return
