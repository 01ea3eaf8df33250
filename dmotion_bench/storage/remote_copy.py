"""A data set on object storage, and the part of it that is here.

What is needed of it lies in a folder of this machine that looks like the data set itself: ``dataset.json`` and the
tables, which are read anew whenever it is opened, and those shards that were asked for, each whole and with the digest
that ``dataset.json`` states. So all that reads data sets reads this folder, and never a byte that is not what was
recorded. Shards that were not used for longest make room for others.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from filelock import FileLock

from dmotion_bench.addresses import last_name
from dmotion_bench.errors import DatasetCorrupt, DatasetMissing, InvalidSetting, StorageFull
from dmotion_bench.storage.atomic import remove_leftovers, write_atomically
from dmotion_bench.storage.limits import LARGEST_MANIFEST
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.object_store import ObjectStore
from dmotion_bench.storage.shard import LABELS, VIDEO, FileFacts, file_facts, shard_path
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import CACHE_VARIABLE, DATASET_MANIFEST, Workspace

ROOM_VARIABLE: Final = "DMBENCH_REMOTE_GIB"
_GIB: Final = 2**30
_LOCKS: Final = "locks"
_ARRIVING: Final = "arriving"


def copies_folder() -> Path:
    """Where copies of remote files are kept: where decoded frames are, or in the workspace."""
    given = os.environ.get(CACHE_VARIABLE)
    return (Path(given) if given else Workspace.current().root / "cache") / "remote"


def copy_folder(address: str, purpose: str = "") -> Path:
    """The folder of one remote data set's copies; its name tells the address and nothing outside can be named."""
    digest = hashlib.sha256(address.encode()).hexdigest()[:12]
    name = "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in last_name(address))[:64]
    return copies_folder() / f"{name}-{digest}{purpose}"


class RemoteCopy:
    """What is here of a remote data set.

    Attributes:
        address: Of the data set.
        folder: Of the copies.
        store: The door to the storage.
    """

    def __init__(self, address: str) -> None:
        self.address, self.folder, self.store = address, copy_folder(address), ObjectStore(address)

    def refresh(self) -> Manifest:
        """Read ``dataset.json`` anew; copies of an earlier data set of this address are deleted.

        Raises:
            DatasetMissing: There is no data set.
            DatasetCorrupt: It is not what is written; the copies stay.
            PlaceUnreachable: The storage does not answer.
        """
        try:
            content = self.store.read(DATASET_MANIFEST, largest=LARGEST_MANIFEST)
        except FileNotFoundError:
            record = command("dmbench record grid_world --out", self.address)
            raise DatasetMissing(
                f"no data set in {shown(self.address)}: there is no {DATASET_MANIFEST}; name another place, or record "
                f"one there with {record}."
            ) from None
        with self._lock(DATASET_MANIFEST):
            there = self.folder / DATASET_MANIFEST
            write_atomically(self.folder / _ARRIVING / DATASET_MANIFEST, content)
            try:
                manifest = Manifest.read(self.folder / _ARRIVING)
            except DatasetCorrupt as damage:
                raise self.damaged(DATASET_MANIFEST, f"is none: {damage}") from None
            if not there.is_file() or there.read_bytes() != content:
                for folder in (VIDEO, LABELS):
                    shutil.rmtree(self.folder / folder, ignore_errors=True)
                write_atomically(there, content)
        return manifest

    def fetch_tables(self, manifest: Manifest) -> None:
        """Have the tables here.

        Raises:
            DatasetCorrupt: One is not there, or not what was written.
            PlaceUnreachable: The storage does not answer.
        """
        for name, facts in manifest.tables.items():
            self._fetch(name, self.folder / name, facts)

    def shard(self, kind: str, index: int, manifest: Manifest) -> Path:
        """A shard's file, which is fetched if it is not here.

        Raises:
            FileNotFoundError: The storage has none, or the data set has none of this kind.
            DatasetCorrupt: The storage holds other bytes.
            PlaceUnreachable: The storage does not answer.
            StorageFull: There is no space for it.
        """
        path = shard_path(self.folder, kind, index)
        entry = manifest.shards[index]
        facts = entry.video if kind == VIDEO else entry.labels
        if facts is None:
            raise FileNotFoundError(path)
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_size == facts.size:
                os.utime(path)  # used last
                return path
        name = f"{kind}/{path.name}"
        with self._lock(path.name + kind):
            if not path.is_file() or path.stat().st_size != facts.size:
                self._make_room(facts.size)
                remove_leftovers(path.parent)
                self.store.fetch(name, facts, path)
        return path

    def sizes(self, kind: str) -> dict[str, int]:
        """The sizes of all files of a kind that the storage has, by name [bytes]."""
        return self.store.sizes(kind)

    def require_whole(self, manifest: Manifest) -> None:
        """See that the storage has every video shard, as long as it was written.

        Raises:
            DatasetCorrupt: It has not.
        """
        found = self.sizes(VIDEO)
        for index, entry in enumerate(manifest.shards):
            name = shard_path(self.folder, VIDEO, index).name
            if found.get(name) != entry.video.size:
                what = f"has {found[name]} bytes instead of {entry.video.size}" if name in found else "is missing"
                raise self.damaged(f"{VIDEO}/{name}", what)

    def damaged(self, name: str, what: object) -> DatasetCorrupt:
        """The error for a damaged file of the storage."""
        check = command("dmbench data check", self.address)
        return DatasetCorrupt(
            f"{shown(f'{self.address}/{name}')} is damaged: it {what}. See what else is with {check}; then put the "
            "data set there again."
        )

    def fetch_all(self, manifest: Manifest, folder: Path) -> None:
        """Copy the whole data set into a folder, ``dataset.json`` first: what is missing is taken for not yet recorded.

        Raises:
            DatasetCorrupt: A file is not what was written.
            PlaceUnreachable: The storage does not answer.
        """
        manifest.write(folder)
        for name, facts in _files_of(manifest):
            path = folder / name
            if not path.is_file() or file_facts(path) != facts:
                try:
                    self.store.fetch(name, facts, path)
                except FileNotFoundError:
                    raise self.damaged(name, "is missing") from None

    def _fetch(self, name: str, path: Path, facts: FileFacts) -> None:
        with self._lock(name):
            if path.is_file() and file_facts(path) == facts:
                return
            try:
                self.store.fetch(name, facts, path)
            except FileNotFoundError:
                raise self.damaged(name, "is missing") from None

    def _lock(self, name: str) -> FileLock:
        folder = self.folder / _LOCKS
        folder.mkdir(parents=True, exist_ok=True)
        return FileLock(folder / f"{name}.lock")

    def _make_room(self, size: int) -> None:
        """Delete the copies that were not used for longest, until another one may be written."""
        files = [file for kind in (VIDEO, LABELS) for file in (self.folder / kind).glob("*.mcap")]
        known = list[tuple[float, int, Path]]()
        for file in files:
            with contextlib.suppress(FileNotFoundError):
                facts = file.stat()
                known.append((facts.st_mtime, facts.st_size, file))
        taken = sum(one[1] for one in known)
        room = _room(taken, shutil.disk_usage(self.folder).free)
        for _, bytes_, file in sorted(known, key=lambda one: one[0]):
            if taken + size <= room:
                return
            file.unlink(missing_ok=True)
            taken -= bytes_
        if size > shutil.disk_usage(self.folder).free:
            raise StorageFull(
                f"no space for a file of {size / _GIB:.1f} GiB of {shown(self.address)} in {shown(str(self.folder))}; "
                f"free some, or name another folder with '--cache DIR'."
            )


def _room(taken: int, free: int) -> int:
    """How much the copies of a data set may take: what the variable says, or half of what is not taken by others."""
    given = os.environ.get(ROOM_VARIABLE)
    if given is None:
        return (taken + free) // 2
    try:
        gigabytes = float(given)
    except ValueError:
        gigabytes = -1.0
    if not 0 < gigabytes < 2**30:
        raise InvalidSetting(
            f"{ROOM_VARIABLE} is {shown(given)}; it can be a number of GiB above zero: how much of a remote data set "
            "may lie on this disk."
        )
    return int(gigabytes * _GIB)


def upload(folder: Path, address: str) -> None:
    """Put a complete data set there; ``dataset.json`` comes last, so no reader takes a part of it for the whole.

    What is there already, by what the ``dataset.json`` there says, is not sent again.

    Args:
        folder: Of the data set.
        address: Where it is put.

    Raises:
        PlaceUnreachable: The storage does not take it.
    """
    store, manifest = ObjectStore(address), Manifest.read_complete(folder)
    files = dict(_files_of(manifest))
    there, known = _standing(store)
    changed = [name for name, facts in files.items() if known.get(name) != facts]
    if changed and there:
        store.remove(DATASET_MANIFEST)
    for name in changed:
        store.write(folder / name, name)
    store.write(folder / DATASET_MANIFEST, DATASET_MANIFEST)


def _standing(store: ObjectStore) -> tuple[bool, dict[str, FileFacts]]:
    """Whether a data set is there, and which of its files are as long as they should be."""
    copy = RemoteCopy(store.address)
    try:
        manifest = copy.refresh()
    except DatasetMissing:
        return False, {}
    except DatasetCorrupt:
        return True, {}
    sizes = {f"{kind}/{name}": size for kind in (VIDEO, LABELS) for name, size in store.sizes(kind).items()}
    sizes |= store.sizes("")
    return True, {name: facts for name, facts in _files_of(manifest) if sizes.get(name) == facts.size}


def _files_of(manifest: Manifest) -> Iterable[tuple[str, FileFacts]]:
    """All files but ``dataset.json``."""
    for index, entry in enumerate(manifest.shards):
        for kind, facts in ((VIDEO, entry.video), (LABELS, entry.labels)):
            if facts is not None:
                yield f"{kind}/{shard_path(Path(), kind, index).name}", facts
    yield from manifest.tables.items()
