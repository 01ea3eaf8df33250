"""Temporary folders that a killed process leaves for a while only: the next one that is made takes them away.

Each holds a file that is locked for as long as its process lives. Whoever makes another one looks for folders of the
same user and machine whose file nobody holds. The folder that all of them stand in is one that everybody may write to,
so a link in it is never followed, and nothing is deleted that is not of that form.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from dmotion_bench.storage.lock import NO_LINK, OPENS_FOLDERS, try_lock

_PREFIX: Final = "dmbench-held-"
"""Earlier versions made folders without such a file, which begin otherwise and are nobody's to delete."""
_HELD: Final = "held"


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """A new folder for as long as the block lasts; a process that is killed in it leaves it to the next."""
    _remove_left()
    folder, held = Path(tempfile.mkdtemp(prefix=_PREFIX)), None
    try:
        held = _hold(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if held is not None:
            os.close(held)


def _hold(folder: Path) -> int | None:
    """The locked file of a folder; it has its name only once it is locked."""
    if not OPENS_FOLDERS:  # Windows renames no open file, so nothing is ever taken away there
        return None
    held = os.open(folder / f"{_HELD}.new", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    try_lock(held)
    with contextlib.suppress(OSError):  # the disk is full, which is said where something larger is written
        os.write(held, socket.gethostname().encode())
        (folder / f"{_HELD}.new").rename(folder / _HELD)
    return held


def _remove_left() -> None:
    """Delete the folders of killed processes."""
    if not OPENS_FOLDERS:
        return
    with contextlib.suppress(OSError), os.scandir(tempfile.gettempdir()) as found:
        for one in found:
            if one.name.startswith(_PREFIX):
                with contextlib.suppress(OSError):  # gone meanwhile, of somebody else, or another thing
                    _remove_if_left(one.path)


def _remove_if_left(path: str) -> None:
    with contextlib.ExitStack() as opened:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | NO_LINK)
        opened.callback(os.close, folder)
        held = os.open(_HELD, os.O_RDWR | os.O_NONBLOCK | NO_LINK, dir_fd=folder)
        opened.callback(os.close, held)
        own = os.fstat(folder).st_uid == os.getuid()
        if own and os.read(held, 256) == socket.gethostname().encode() and try_lock(held):
            shutil.rmtree(path, ignore_errors=True)  # which follows no link either
