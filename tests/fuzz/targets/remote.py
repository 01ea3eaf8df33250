"""Data sets on object storage: spoilt files, and a storage whose lists and bodies are not to be trusted."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from dmotion_bench.storage import object_store
from dmotion_bench.storage.dataset import Dataset
from tests.fuzz.case import Answers, Case, Fault, Probe
from tests.fuzz.command import dmbench
from tests.fuzz.mutations import pick
from tests.fuzz.mutations.names import HOSTILE_NAMES
from tests.fuzz.targets.dataset import DatasetTarget, SpoiltDataset, identity
from tests.fuzz.targets.share import snapshot
from tests.fuzz.worlds import MOVES, write_noise

BUCKET = "s3://bucket"
BODIES = ("cut", "more", "whole", "flip", "turns", "empty", "other", "error")
LISTS = ("names", "sizes", "types", "gone", "twice", "keys", "error")
ERRORS = (OSError("no route"), KeyError("Contents"), ValueError("no XML"), RecursionError(), UnicodeDecodeError)


@dataclass
class Storage:
    """A file system of fsspec's kind, of a folder on this disk; some of its answers are lies.

    Attributes:
        root: What is the bucket.
        rng: Of the lies.
        bodies, lists: The lies about the bytes of files with these ends of their names, and about folders.
    """

    root: Path
    rng: np.random.Generator
    bodies: dict[str, str] = field(default_factory=dict)
    lists: str = ""
    _asked: int = 0

    def cat_file(self, address: str, start: int, end: int) -> bytes:
        """A piece of a file."""
        path, self._asked = self._path(address), self._asked + 1
        whole = path.read_bytes()
        lie = next((lie for ending, lie in self.bodies.items() if path.name.endswith(ending)), "")
        return self._lied(lie, path, whole, whole[start:end])

    def ls(self, address: str, detail: bool) -> list[Mapping[str, Any]]:
        """What lies in a folder."""
        assert detail
        folder = self._path(address)
        found = [
            {
                "name": f"{address}/{one.name}".removeprefix("s3://"),
                "size": one.stat().st_size,
                "type": "directory" if one.is_dir() else "file",
            }
            for one in sorted(folder.iterdir())
            if one.exists()  # a bucket has no links that lead nowhere
        ]
        return [self._listed(dict(one)) for one in found] + found * (self.lists == "twice")

    def invalidate_cache(self) -> None:
        """Nothing is kept."""

    def _path(self, address: str) -> Path:
        inside = PurePosixPath(address.removeprefix(BUCKET).lstrip("/"))
        if not address.startswith(BUCKET) or ".." in inside.parts:
            raise Fault("asked outside", f"the storage is asked for {address!r}")
        return self.root / inside

    def _lied(self, lie: str, path: Path, whole: bytes, piece: bytes) -> bytes:
        if lie == "error":
            raise self._error()
        if lie == "other":
            return pick(self.rng, sorted(one for one in path.parent.iterdir() if one.is_file())).read_bytes()
        flipped = bytearray(piece)
        if piece and (lie == "flip" or (lie == "turns" and self._asked % 2)):
            flipped[int(self.rng.integers(len(piece)))] ^= 1 << int(self.rng.integers(8))
        lies = {"cut": piece[: len(piece) // 2], "more": piece + piece, "whole": whole, "empty": b""}
        return lies.get(lie, bytes(flipped))

    def _listed(self, one: dict[str, Any]) -> Mapping[str, Any]:
        if self.lists == "error":
            raise self._error()
        if self.lists == "names":
            name = pick(self.rng, (*HOSTILE_NAMES, "", "..", "../../secret", "a/../../secret", "/etc/passwd"))
            one["name"] = f"{one['name'].rpartition('/')[0]}/{name}"
        elif self.lists == "sizes":
            one["size"] = pick(self.rng, (-1, 0, 2**63, 10**30, None, "12", 1.5, float("nan")))
        elif self.lists == "types":
            one["type"] = pick(self.rng, ("directory", "file", "link", None, 7))
        elif self.lists == "gone":
            one["type"] = "link"
        elif self.lists == "keys":
            one.pop(pick(self.rng, ("name", "size", "type")))
        return one

    def _error(self) -> Exception:
        error = pick(self.rng, ERRORS)
        return error if isinstance(error, Exception) else error("utf-8", b"\xff", 0, 1, "no text")


@dataclass
class SpoiltRemote(SpoiltDataset):
    """A spoilt data set in a bucket, and the storage that lies."""

    storage: Storage = field(kw_only=True)


class RemoteTarget(DatasetTarget):
    """See above."""

    name: ClassVar[str] = "remote"
    share: ClassVar[int] = 2

    def make(self) -> None:
        """Noise with labels, the same without, and noise with continuous actions."""
        write_noise(self.originals / "noise")
        write_noise(self.originals / "moves", MOVES)
        video = shutil.copytree(self.originals / "noise", self.originals / "video")
        shutil.rmtree(video / "labels")

    def names(self) -> list[str]:
        return ["noise", "noise", "moves", "video"]

    def intact(self, case: Case, name: str) -> SpoiltRemote:
        spoilt = super().intact(case, name)
        storage = Storage(spoilt.path.parent, np.random.default_rng(0))
        return SpoiltRemote(spoilt.path, name, spoilt.files, storage=storage)

    def spoil(self, case: Case) -> SpoiltRemote:
        if not case.chance(0.5):
            damaged = super().spoil(case)
            assert isinstance(damaged, SpoiltRemote)  # as ``intact`` makes it
            if not any(one.is_file() for one in (damaged.path / "labels").glob("*")):  # no folders are in a bucket
                damaged.unlabelled = True
                damaged.files = [name for name in damaged.files if not name.startswith("labels")]
            return damaged
        spoilt = self.intact(case, pick(case.rng, self.names()))
        spoilt.storage.rng = np.random.default_rng(int(case.rng.integers(2**32)))
        if case.chance(0.7):
            ending, lie = pick(case.rng, ("", ".json", ".parquet", ".mcap")), pick(case.rng, BODIES)
            spoilt.storage.bodies[ending] = lie
            case.tell(f"bodies of *{ending}", lie)
        else:
            spoilt.storage.lists = pick(case.rng, LISTS)
            case.tell("lists", spoilt.storage.lists)
        return spoilt

    def probes(self, case: Case, spoilt: SpoiltDataset) -> Iterator[Probe]:
        assert isinstance(spoilt, SpoiltRemote)
        os.environ["DMBENCH_WORKSPACE"] = str(case.folder / "workspace")
        object_store.PAUSES = (0.0, 0.0)
        object_store._file_system = lambda _address: spoilt.storage
        address = f"{BUCKET}/{spoilt.path.name}"
        before = snapshot(spoilt.path.parent)
        opened: list[Dataset] = []

        def open_it() -> Any:
            opened.append(Dataset.open(address))
            return identity(opened[0])

        yield Probe("open", open_it)
        yield Probe("info", lambda: dmbench("data", "info", address, "--json").json() and None)
        if opened:
            yield from self._reads(case, opened[0])
        yield Probe("check", lambda: dmbench("data", "check", address, "--json").json()["sound"])
        yield Probe("unchanged", lambda: _unchanged(case.folder, spoilt.path.parent, before))

    def judge(
        self, case: Case, spoilt: SpoiltDataset, answers: Answers, reference: dict[str, Any]
    ) -> Iterator[tuple[str, str]]:
        assert isinstance(spoilt, SpoiltRemote)
        lies = spoilt.storage.bodies or spoilt.storage.lists
        for kind, what in super().judge(case, spoilt, answers, reference):
            if not (lies and kind == "check contradicted"):  # a storage may answer now and not then
                yield kind, what


def _unchanged(folder: Path, bucket: Path, before: Mapping[str, str]) -> None:
    """See that reading has written into the workspace alone."""
    if snapshot(bucket) != before:
        raise Fault("wrote outside", "reading has changed what lies in the bucket")
    if others := {one.name for one in folder.iterdir()} - {"workspace", bucket.name}:
        raise Fault("wrote outside", f"reading has left {sorted(others)}")
