"""Where files arrive before they are verified: a folder that takes its place as a whole.

A command that was interrupted leaves the folder; the same command goes on with what has arrived.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from dmotion_bench.errors import FolderInUse, ShareCorrupt, StorageFull, UsageError
from dmotion_bench.sharing.place import Place, damaged
from dmotion_bench.storage.atomic import remove_leftovers, sync_folder
from dmotion_bench.storage.lock import FolderLock
from dmotion_bench.storage.shard import FileFacts, file_facts
from dmotion_bench.wording import shown

ARRIVING: Final = ".arriving"
_GIB: Final = 2**30
Files = Mapping[str, tuple[str, FileFacts]]
"""By their paths in the folder here: their names in the place, and what they are."""


@contextlib.contextmanager
def arriving(beside: Path, name: str, files: Files) -> Iterator[Path]:
    """A folder that nobody else writes into meanwhile; of what has arrived in it, it keeps what is still wanted.

    Args:
        beside: The folder of all runs, or of all data sets: what arrives is on its disk, wherever that is.
        name: Tells what arrives.
        files: What is to arrive.

    Raises:
        FolderInUse: Another process fetches the same.
    """
    folder = beside / ARRIVING / name
    if folder.is_symlink() or folder.parent.is_symlink():
        raise UsageError(f"{shown(str(folder))} is a link; delete it.")
    folder.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(folder)
    try:
        if not folder.is_dir() or not lock.is_on(folder):
            raise FolderInUse(f"another dmbench has just fetched {shown(name)}; run the same command again.")
        for one in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            remove_leftovers(one)
        _keep_only(folder, files)
        yield folder
    finally:
        lock.release()
        with contextlib.suppress(OSError):
            folder.parent.rmdir()


def _keep_only(folder: Path, files: Files) -> None:
    """Delete what an earlier try has left and nobody verifies: from another place, or with labels."""
    for path in sorted(folder.rglob("*"), reverse=True):  # what is in a folder before the folder
        if path.is_dir() and not path.is_symlink():
            with contextlib.suppress(OSError):  # not empty
                path.rmdir()
        elif path.relative_to(folder).as_posix() not in files:
            path.unlink()


def take(place: Place, files: Files, folder: Path, on_done: Callable[[int, int], None]) -> dict[str, FileFacts]:
    """Fetch the files that have not arrived yet, each whole and with its hash; those that were fetched.

    Args:
        place: Where from.
        files: Which ones.
        folder: Where to.
        on_done: Told how many are here, and of how many.

    Raises:
        ShareCorrupt: The place lacks one, or holds other bytes.
        StorageFull: They do not fit on this disk.
        PlaceUnreachable: The place does not answer.
    """
    lacking = {path: one for path, one in files.items() if not _has(folder / path, one[1])}
    needed, free = sum(facts.size for _, facts in lacking.values()), shutil.disk_usage(folder).free
    if needed > free:
        raise StorageFull(
            f"{needed / _GIB:.1f} GiB are to be fetched from {shown(place.address)}, and {free / _GIB:.1f} GiB are "
            f"free where {shown(str(folder))} is; free some, or name another workspace with DMBENCH_WORKSPACE."
        )
    for done, (path, (name, facts)) in enumerate(lacking.items(), len(files) - len(lacking)):
        on_done(done, len(files))
        try:
            place.fetch(name, facts, folder / path)
        except FileNotFoundError:
            raise damaged(f"{place.address}/{name}", "it is missing") from None
    on_done(len(files), len(files))
    return {path: facts for path, (_, facts) in lacking.items()}


def _has(path: Path, facts: FileFacts) -> bool:
    return path.is_file() and not path.is_symlink() and file_facts(path) == facts


@contextlib.contextmanager
def refused(folder: Path, address: str) -> Iterator[None]:
    """Delete what has arrived if it turns out to be something else than its name says.

    Raises:
        ShareCorrupt: The block raised ValueError with the reason.
    """
    try:
        yield
    except ValueError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise ShareCorrupt(
            f"{shown(address)} is not what its name says: {error}. Nothing of it is used; ask whoever published it, or "
            "name another place that has it."
        ) from None


def settle(folder: Path, target: Path) -> None:
    """Give what has arrived its place, in one step.

    Raises:
        FolderInUse: Something else has appeared there meanwhile.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.rename(target)
    except OSError as error:
        if not target.exists():
            raise
        raise FolderInUse(
            f"{shown(str(target))} has appeared meanwhile ({error.strerror}); what was fetched is in "
            f"{shown(str(folder))}. Run the same command again."
        ) from None
    sync_folder(target.parent)
