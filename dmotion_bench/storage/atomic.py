"""Files that appear complete or not at all: temporary name, fsync, rename, fsync of the folder."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from dmotion_bench.errors import StorageFull
from dmotion_bench.storage.lock import NO_LINK, OPENS_FOLDERS, try_lock

TEMPORARY_SUFFIX = ".part"
_TEMPORARY: Final = re.compile(rf".+\.[0-9a-f]{{8}}\{TEMPORARY_SUFFIX}")
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a disk, a quota or a file that can take no more."""


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that its file names survive a power cut; Windows has no way to ask for that."""
    if not OPENS_FOLDERS:
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def atomic_file(path: Path, *, make_folders: bool = True) -> Iterator[BinaryIO]:
    """A file that appears under ``path`` when the block ends well, and leaves nothing when it does not.

    A process that is killed leaves ``<name>.<token>.part``, which ``remove_leftovers`` takes away.
    Two processes may write the same file, even on two machines: the tokens keep their pieces apart. As long as its
    process lives, the temporary file is locked.

    Args:
        path: The file.
        make_folders: Whether missing folders above it are made. A folder that is moved away while it is written
            into is made again by this; without it, that is a ``FileNotFoundError``.

    Raises:
        StorageFull: There is no space left.
    """
    with saying_full(path), _written(path, make_folders) as file:
        yield file


@contextlib.contextmanager
def saying_full(path: Path) -> Iterator[None]:
    """Within the block, which writes a file, a disk that can take no more is said with the file's name.

    Raises:
        StorageFull: There is no space left.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise StorageFull(
            f"no space left on the device while writing {str(path)!r}; what is finished beside it is whole. "
            "Free some space and run the same command again: it goes on where it stopped."
        ) from None


@contextlib.contextmanager
def _written(path: Path, make_folders: bool) -> Iterator[BinaryIO]:
    if make_folders:
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary, file = _temporary(path)
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if OPENS_FOLDERS:
                temporary.replace(path)  # still locked
        if not OPENS_FOLDERS:  # Windows renames no open file
            temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def _temporary(path: Path) -> tuple[Path, BinaryIO]:
    """A new file beside ``path``, locked."""
    while True:
        temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")
        file = temporary.open("xb")
        if try_lock(file.fileno()) is not False and os.fstat(file.fileno()).st_nlink:
            return temporary, file
        file.close()  # it was taken for a leftover before it was locked


def write_atomically(path: Path, data: bytes, *, make_folders: bool = True) -> None:
    """Replace a small file in one step; for ``make_folders`` see ``atomic_file``."""
    with atomic_file(path, make_folders=make_folders) as file:
        file.write(data)


def is_unused(folder: Path) -> bool:
    """Whether a folder is missing, empty, or holds nothing but temporary files of a process that was killed."""
    return not folder.is_dir() or all(_TEMPORARY.fullmatch(path.name) for path in folder.iterdir())


def remove_leftovers(folder: Path) -> None:
    """Delete the temporary files of processes that were killed; those that are still written stay.

    On a file system without locks all of them stay. Other programs' files stay, whatever their suffix.
    """
    for leftover in folder.glob(f"*{TEMPORARY_SUFFIX}"):
        if not _TEMPORARY.fullmatch(leftover.name):
            continue
        with contextlib.suppress(OSError):  # gone meanwhile, or not ours to delete
            if not OPENS_FOLDERS:
                leftover.unlink()  # Windows refuses while anybody has it open
                continue
            handle = os.open(leftover, os.O_RDWR | os.O_NONBLOCK | NO_LINK)  # read-only, NFS would not lock it
            try:
                if try_lock(handle):
                    leftover.unlink()
            finally:
                os.close(handle)
