"""A place to publish in: a folder, or object storage."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Final, Protocol

from dmotion_bench.addresses import PROTOCOLS, remote_address
from dmotion_bench.errors import DmbenchError, PlaceUnreachable, ShareCorrupt, UsageError
from dmotion_bench.storage.atomic import atomic_file, remove_leftovers
from dmotion_bench.storage.limits import LONGEST_NAME
from dmotion_bench.storage.object_store import ObjectStore
from dmotion_bench.storage.shard import FileFacts
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, as_path

RUNS: Final = "runs"
DATASETS: Final = "datasets"
HASH: Final = re.compile(r"[0-9a-f]{64}")
_PIECE: Final = 2**20
_FORBIDDEN: Final = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]')


class Place(Protocol):
    """Where things are published; names are paths below its address, made of hashes and of names that were checked."""

    @property
    def address(self) -> str:
        """The folder's path, or an address such as ``s3://bucket/path``."""

    def read(self, name: str, *, largest: int) -> bytes:
        """A small file whose digest nobody knows; raises FileNotFoundError."""

    def fetch(self, name: str, facts: FileFacts, to: Path) -> None:
        """Copy a file here, whole and with its digest or not at all; raises FileNotFoundError and ShareCorrupt."""

    def holds(self, name: str, facts: FileFacts) -> bool:
        """Whether a file is there with these bytes: it is read as a whole."""

    def sizes(self, folder: str) -> dict[str, int]:
        """The files in a folder with their sizes; empty if there is no such folder."""

    def folders(self, folder: str) -> list[str]:
        """The names of the folders in a folder."""

    def write(self, file: Path, name: str) -> None:
        """Put a file there, under its name whole or not at all."""

    def remove(self, name: str) -> None:
        """Delete a file, if it is there."""


def open_place(given: AnyPath) -> Place:
    """The place of a path or an address.

    Raises:
        UsageError: There can be no such place.
    """
    as_path("place to share in", given)
    if (address := remote_address(given)) is not None:
        return StoragePlace(address)
    text = os.fspath(given)
    if re.match(r"\w[\w+.-]+:/", text) and not Path(text).is_dir():
        known = ", ".join(f"{protocol}://" for protocol in PROTOCOLS)
        raise UsageError(
            f"{shown(text)} is no place to share in; name a folder, or an address that begins with {known}."
        )
    if not text:
        raise UsageError("no place to share in is named; name a folder, or an address as s3://bucket.")
    path = Path(text)
    if path.exists() and not path.is_dir():
        raise UsageError(
            f"{shown(text)} is a file and no place to share in; name a folder, or an address as s3://bucket."
        )
    return FolderPlace(path)


def plain_name(name: object) -> bool:
    """Whether a name that came from elsewhere may become a folder's name: one part of a path, nothing hidden."""
    return (
        isinstance(name, str)
        and 0 < len(name) <= LONGEST_NAME - 64
        and name.isprintable()
        and not _FORBIDDEN.search(name)
        and name[0] not in ".~- "
        and name[-1] not in ". "
    )


def damaged(address: str, what: object) -> ShareCorrupt:
    """The error for something published that is not what its name says."""
    return ShareCorrupt(
        f"{shown(address)} is damaged: {what}. Nothing of it is used. Whoever published it can mend it with "
        "'dmbench share push ... --mend'; or name another place that has it."
    )


class StoragePlace(ObjectStore):
    """Object storage as a place."""

    described_by = "its name or its manifest"

    def write(self, file: Path, name: str) -> None:
        """As ``ObjectStore.write``; a bucket that is not there is said.

        Raises:
            PlaceUnreachable: The storage does not take it.
        """
        try:
            super().write(file, name)
        except FileNotFoundError:
            if not file.is_file():
                raise
            raise PlaceUnreachable(
                f"nothing can be written to {shown(self.address)}: there is no such bucket or repository; make it "
                "first, or check the address."
            ) from None

    def _damaged(self, name: str, what: object) -> DmbenchError:
        return damaged(f"{self.address}/{name}", what)


class FolderPlace:
    """A folder as a place, on this machine or shared among several.

    Links in it are not followed: somebody else may have put them there, and what is written through one replaces files
    anywhere.

    Args:
        path: The folder; ``write`` makes it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._tidied = set[Path]()

    @property
    def address(self) -> str:
        """Its path."""
        return str(self._path)

    def read(self, name: str, *, largest: int) -> bytes:
        """A whole small file.

        Raises:
            FileNotFoundError: There is none.
            ShareCorrupt: It is no ordinary file.
        """
        with self._opened(name) as file:
            return file.read(largest)

    def fetch(self, name: str, facts: FileFacts, to: Path) -> None:
        """Copy a file here.

        Raises:
            FileNotFoundError: There is none.
            ShareCorrupt: It holds other bytes.
        """
        with self._opened(name) as source, atomic_file(to) as file:
            if _facts(source, facts.size, file.write) != facts:
                raise damaged(self._at(name), "it does not hold the bytes that its name or its manifest describes")

    def holds(self, name: str, facts: FileFacts) -> bool:
        """Whether a file is there with these bytes."""
        try:
            with self._opened(name) as source:
                return _facts(source, facts.size, lambda _piece: None) == facts
        except (FileNotFoundError, ShareCorrupt):
            return False

    def sizes(self, folder: str) -> dict[str, int]:
        """The files in a folder, without links."""
        return {one.name: one.stat().st_size for one in self._listed(folder) if one.is_file(follow_symlinks=False)}

    def folders(self, folder: str) -> list[str]:
        """The folders in a folder, without links."""
        return sorted(one.name for one in self._listed(folder) if one.is_dir(follow_symlinks=False))

    def write(self, file: Path, name: str) -> None:
        """Put a copy of a file there; what killed processes left beside it is deleted.

        Raises:
            ShareCorrupt: A folder above it is a link.
            UsageError: A folder above it is a file.
        """
        there = self._file(name)
        try:
            there.parent.mkdir(parents=True, exist_ok=True)
        except (NotADirectoryError, FileExistsError):
            raise UsageError(
                f"nothing can be written to {shown(str(self._path))}: {shown(str(there.parent))} cannot be a folder, a "
                "file is in the way; delete that file, or name another place."
            ) from None
        if there.parent not in self._tidied:
            remove_leftovers(there.parent)
            self._tidied.add(there.parent)
        with file.open("rb") as source, atomic_file(there) as target:
            shutil.copyfileobj(source, target, _PIECE)

    def remove(self, name: str) -> None:
        """Delete a file, if it is there."""
        self._file(name).unlink(missing_ok=True)

    def _at(self, name: str) -> str:
        return str(self._path / name)

    def _file(self, name: str) -> Path:
        folder, _, last = name.rpartition("/")
        return self._folder(folder) / last

    def _folder(self, name: str) -> Path:
        """The path of a folder that is no link, nor below one.

        Raises:
            ShareCorrupt: It is.
        """
        path = self._path
        for part in name.split("/"):
            path /= part
            if path.is_symlink():
                raise ShareCorrupt(
                    f"{shown(str(path))} is a link, and links in a place are not followed; delete it, or put the "
                    "folder that it leads to in its stead."
                )
        return path

    def _listed(self, folder: str) -> list[os.DirEntry[str]]:
        try:
            with os.scandir(self._folder(folder)) as found:
                return list(found)
        except (FileNotFoundError, NotADirectoryError, ShareCorrupt):
            return []

    @contextlib.contextmanager
    def _opened(self, name: str) -> Iterator[BinaryIO]:
        path = self._file(name)
        try:
            if not stat.S_ISREG(path.lstat().st_mode):  # a pipe would be waited for, a link leads anywhere
                raise damaged(str(path), "it is no ordinary file")
        except NotADirectoryError:
            raise FileNotFoundError(path) from None
        with path.open("rb") as file:
            yield file


def _facts(source: BinaryIO, size: int, take: Callable[[bytes], object]) -> FileFacts:
    """Size and digest of a file that is passed on; no more than ``size`` bytes and one are read."""
    digest, count = hashlib.sha256(), 0
    while count <= size and (piece := source.read(min(_PIECE, size + 1 - count))):
        digest.update(piece)
        take(piece)
        count += len(piece)
    return FileFacts(count, digest.hexdigest())
