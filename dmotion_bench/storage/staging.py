"""Folders that appear complete or not at all: written under a temporary name and renamed at the end.

What is not finished stands in ``NAME.importing/`` with a marker beside it, and is locked by the process that fills
it. So what a killed process left can be told from anything else of that name, and from what another process is
still filling; only the former is deleted, by the next that wants the name.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from dmotion_bench.errors import StorageFull, UsageError
from dmotion_bench.storage.atomic import FULL, sync_folder
from dmotion_bench.storage.lock import ANOTHER_FOLDER, FolderLock, lock_beside

MARKER: Final = "unfinished.txt"
CONTENT: Final = "content"
_LOCK: Final = lock_beside(Path(CONTENT)).name  # of whoever wrote there, where that was killed
_TEXT: Final = "Left behind by a dmbench that was killed. The same command deletes this folder; so may you.\n"


@contextlib.contextmanager
def staged(out: Path, suffix: str, *, keep: bool = False) -> Iterator[Path]:
    """A new, empty folder that gets the name ``out`` when the block ends well, and is deleted when it does not.

    Args:
        out: Not there yet, or an empty folder.
        suffix: Of the folder beside it.
        keep: Leave the folder as it is when the block does not end well, and give it out again the next time.

    Raises:
        UsageError: Something that no killed process left is in the way.
        DatasetError: Another process is filling the folder.
        StorageFull: There is no space left.
    """
    out = out.resolve()
    outer = _beside(out, suffix)
    lock, whole = _claim(outer, keep), False
    try:
        (outer / MARKER).write_text(_TEXT)
        content = outer / CONTENT
        content.mkdir(exist_ok=keep)
        yield content
        _sync(content)
        if out.exists():
            out.rmdir()
        content.rename(out)
        whole = True
        sync_folder(out.parent)
    except (StorageFull, OSError) as error:
        if isinstance(error, OSError) and error.errno not in FULL:
            raise
        raise StorageFull(
            f"no space left on the device for {str(out)!r}; "
            f"{'what is finished stays' if keep else 'nothing is left of it'}. Free some space, or name another "
            "folder with '--out DIR', and run the command again."
        ) from None
    finally:
        if whole or not keep:
            _delete(outer)
        lock.release()


def _sync(folder: Path) -> None:
    """Bring all that stands in a folder to the disk, so that a power cut finds it under the folder's later name."""
    for path in (folder, *folder.rglob("*")):
        if path.is_dir():
            sync_folder(path)
        elif path.is_file():
            with path.open("r+b") as file:  # Windows syncs no file that is open for reading
                os.fsync(file.fileno())


def sweep(out: Path, suffix: str) -> None:
    """Delete what a killed process left beside ``out``, if there is anything."""
    outer = _beside(out, suffix)
    if outer.is_dir() and not outer.is_symlink() and (outer / MARKER).is_file():
        lock = _claim(outer)
        _delete(outer)
        lock.release()


def _beside(out: Path, suffix: str) -> Path:
    """The temporary folder beside ``out``."""
    whole = out.resolve()  # '.' has no name to put a suffix on
    if not whole.name:
        raise UsageError(f"{str(out)!r} cannot be made anew; name another folder with '--out DIR'.")
    return whole.with_name(f"{whole.name}{suffix}")


def _claim(outer: Path, keep: bool = False) -> FolderLock:
    """The lock on a folder that is there and, unless ``keep`` is set, empty."""
    while True:
        try:
            outer.mkdir(parents=True, exist_ok=True)
        except NotADirectoryError:
            file = next(parent for parent in outer.parents if parent.exists())
            raise UsageError(f"{str(file)!r} is no folder; name another one with '--out DIR'.") from None
        except FileExistsError:
            raise _in_the_way(outer) from None
        if outer.is_symlink():
            raise _in_the_way(outer)
        lock = FolderLock(outer, ANOTHER_FOLDER)
        try:
            if outer.exists() and lock.is_on(outer):  # else its owner has just finished
                _empty(outer, keep)
                return lock
        except BaseException:
            lock.release()
            raise
        lock.release()


def _empty(outer: Path, keep: bool) -> None:
    inside = {path.name for path in outer.iterdir()}
    if inside - {MARKER, CONTENT, _LOCK} or (inside and MARKER not in inside):
        raise _in_the_way(outer)
    if CONTENT in inside and not keep:
        shutil.rmtree(outer / CONTENT)


def _in_the_way(outer: Path) -> UsageError:
    return UsageError(f"{str(outer)!r} is in the way; move it, or name another folder with '--out DIR'.")


def _delete(outer: Path) -> None:
    """The marker goes last, so that whatever is left can still be told for what it is."""
    shutil.rmtree(outer / CONTENT, ignore_errors=True)
    if not (outer / CONTENT).exists():
        (outer / _LOCK).unlink(missing_ok=True)
        (outer / MARKER).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            outer.rmdir()
