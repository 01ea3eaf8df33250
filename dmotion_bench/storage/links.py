"""Links in a folder that came from somebody else: none is followed out of the folder.

A data set or a run that was unpacked or downloaded may hold a link to any file of this machine. Followed, it would be
read, published with the rest, or written through. Whoever opens such a folder therefore asks here first. A folder that
is itself a link is its owner's, and a link to something else in the same folder leads to nothing new: both are in use.

Hard links cannot be told from files: a copy by ``cp --link`` is made of them. Nothing is ever written into a file that
stands, so no other file is changed by way of one.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

from dmotion_bench.errors import DmbenchError
from dmotion_bench.wording import shown


def require_no_link_out(manifest: Path, kind: str, error: type[DmbenchError], *, others: Collection[str] = ()) -> None:
    """See that no link in a folder leads out of it.

    Hidden files are left out, unless a link leads to them: no file of dmbench's is hidden, and of other programs' there
    may be any number.

    Args:
        manifest: The file that makes the folder one of dmbench's; without it nothing is looked at.
        kind: What the folder is, for the sentence.
        error: Of that kind.
        others: Names in it of what other programs write and dmbench never reads.

    Raises:
        error: A link leads out; says which one, and where to.
        PermissionError: A folder may not be listed, and files in it could be opened all the same.
    """
    if not os.path.lexists(manifest):
        return
    folder = manifest.parent
    whole = Path(os.path.realpath(folder))
    waiting, known = [whole], {whole}
    while waiting:
        place = waiting.pop()
        for one in _listed(place):
            if one.name.startswith(".") or (place == whole and one.name in others):
                continue
            if one.is_symlink():
                path = _within(folder / Path(one.path).relative_to(whole), whole, kind, error)
            elif one.is_dir():
                path = Path(one.path)
            else:
                continue
            if path not in known and path.is_dir():
                known.add(path)
                waiting.append(path)


def _listed(place: Path) -> list[os.DirEntry[str]]:
    """What stands in a folder; nothing where it is gone meanwhile, or lets nobody in."""
    try:
        with os.scandir(place) as found:
            return list(found)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except PermissionError:
        if os.access(place, os.X_OK):
            raise
        return []


def require_within(path: Path, folder: Path, kind: str, error: type[DmbenchError]) -> None:
    """See that a path, be it a link or below one, leads to nothing outside of a folder.

    Raises:
        error: It does; says where to.
    """
    _within(path, Path(os.path.realpath(folder)), kind, error)


def _within(path: Path, whole: Path, kind: str, error: type[DmbenchError]) -> Path:
    """Where a path leads, in a folder without links above it."""
    target = Path(os.path.realpath(path))  # Path.resolve() fails at a link to itself
    if not target.is_relative_to(whole):
        raise error(
            f"{shown(str(path))} is a link that leads out of the {kind}'s folder, to {shown(str(target))}, and is not "
            "followed; put what it leads to in its place, or delete it. To keep it all on another disk, move the "
            "whole folder there and link that."
        )
    return target
