"""The read side of a data set: episodes, labels, splits, tasks, and the cache of its frames.

A data set on object storage is read by way of its copy here, shard by shard (``remote_copy.py``).

Opening reads ``dataset.json`` and ``episodes.parquet`` and looks whether the video is there; ``labels/`` is
opened by ``labels``, ``states`` and ``episode`` alone, and may be missing.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np
from jaxtyping import Int, UInt8

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.addresses import last_name, remote_address
from dmotion_bench.errors import DatasetCorrupt, DatasetIncomplete, LabelsNotAvailable, UnknownName, UsageError
from dmotion_bench.specs import Episode, EpisodeLabels, SplitName
from dmotion_bench.storage.frame_cache import CacheFile, FrameCache
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.mcap_reader import DamagedFile, Room, read_messages
from dmotion_bench.storage.messages import StateLabels, chunk_limit, decode_masks
from dmotion_bench.storage.remote_copy import RemoteCopy
from dmotion_bench.storage.shard import LABELS, VIDEO, EpisodeRow, read_states, read_video, shard_path
from dmotion_bench.storage.split import SPLIT_NAMES, split_episodes
from dmotion_bench.storage.tables import EPISODES, TASKS, EpisodeTable, read_episodes, read_tasks
from dmotion_bench.storage.tasks import ControlTask
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import CACHE, AnyPath, cache_folder

_FETCHED_AGAIN: Final = 10  # a copy that made room for others before it was opened
Read = TypeVar("Read")


class Dataset:
    """A complete data set; holds no file open, so it may be handed to other processes.

    Attributes:
        path: Its folder; of one on object storage that of the copies that are here.
        remote: The storage that it is on; None for a folder.
        name: The folder's name, or the last part of the address.
        manifest: The content of ``dataset.json``.
        recipe, spec: How it was made, and what is true of every episode; see also ``numbered`` and ``bounded``.
        fingerprint: SHA-256 over format, recipe and the hashes of all shards.
        rows: Where each episode is and how it came about.
        lengths: Frames of each episode.
    """

    def __init__(self, path: Path, manifest: Manifest, rows: EpisodeTable, remote: RemoteCopy | None = None) -> None:
        self.path, self.manifest, self.rows, self.remote = path, manifest, rows, remote
        self.name = path.resolve().name if remote is None else last_name(remote.address)
        self.recipe, self.spec, self.fingerprint = manifest.recipe, manifest.spec, manifest.fingerprint
        self.lengths = rows.lengths
        self._cache: FrameCache | None = None
        self._numbers: Int[np.ndarray, " a"] | None = None  # of the stored actions, where they are numbered anew

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": None}

    @classmethod
    def open(cls, path: AnyPath) -> Self:
        """The data set in a folder, or at an address such as ``s3://bucket/path``.

        Raises:
            DatasetMissing: There is none.
            DatasetIncomplete: Its recording was interrupted.
            DatasetVersionUnknown: It is of another version of the format.
            DatasetCorrupt: Its tables are damaged, or a video shard is missing or cut off.
            PlaceUnreachable: The storage does not answer.
        """
        if (address := remote_address(path)) is not None:
            return cls._at(RemoteCopy(address))
        path = Path(path)
        manifest = Manifest.read_complete(path)
        try:
            rows = read_episodes(path, manifest)
        except DamagedFile as damage:
            raise corrupt(path, path / EPISODES, damage) from None
        for index, shard in enumerate(manifest.shards):
            file = shard_path(path, VIDEO, index)
            if not file.is_file():
                raise corrupt(path, file, "is missing")
            size = file.stat().st_size
            if size != shard.video.size:
                raise corrupt(path, file, f"has {size} bytes instead of {shard.video.size}")
        return cls(path, manifest, rows)

    @classmethod
    def _at(cls, remote: RemoteCopy) -> Self:
        manifest = remote.refresh()
        if not manifest.complete:
            raise DatasetIncomplete(
                f"the data set {shown(remote.address)} is not whole; record it into a folder and put it there again."
            )
        remote.fetch_tables(manifest)
        remote.require_whole(manifest)
        try:
            return cls(remote.folder, manifest, read_episodes(remote.folder, manifest), remote)
        except DamagedFile as damage:
            raise remote.damaged(EPISODES, damage) from None

    @property
    def where(self) -> Path | str:
        """What opens it again: the folder, or the address."""
        return self.path if self.remote is None else self.remote.address

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "t h w 3"]]:
        """The video of each episode in turn, RGB 0-255; ``labels/`` is not opened."""
        room = Room()
        for episode in range(len(self)):
            yield self.video(episode, room)

    def __fspath__(self) -> str:
        """Its folder: a data set may stand wherever a path may."""
        return str(self.where)

    def numbered(self, names: Sequence[str]) -> Dataset:
        """The same data set with its discrete actions numbered in another order; ``manifest`` keeps the stored one.

        Args:
            names: Of its actions, in the order of their new numbers.

        Raises:
            UsageError: They are other names, or the actions are not discrete.
        """
        stored = self.manifest.spec.actions
        if not isinstance(stored, Discrete) or sorted(names) != sorted(stored.names):
            raise UsageError(
                f"the actions of {shown(self.name)} are {shown(str(stored))}, and {shown(list(names))} were named; "
                "name the same ones in another order."
            )
        view = copy.copy(self)
        view.spec = replace(self.spec, actions=Discrete(tuple(names)))
        view._numbers = np.array([tuple(names).index(name) for name in stored.names], np.int64)
        return view

    def bounded(self, actions: Continuous) -> Dataset:
        """The same data set with other bounds of its continuous actions; ``manifest`` keeps the stored ones.

        Models normalise actions by these bounds. The actions themselves stay, so some may lie beyond.

        Args:
            actions: With the same names and units.

        Raises:
            UsageError: They have others, or the stored actions are not continuous.
        """
        stored = self.manifest.spec.actions
        if not isinstance(stored, Continuous) or (stored.names, stored.units) != (actions.names, actions.units):
            raise UsageError(
                f"the actions of {shown(self.name)} are {shown(str(stored))}, and {shown(str(actions))} were named; "
                "name the same ones with other bounds."
            )
        view = copy.copy(self)
        view.spec = replace(self.spec, actions=actions)
        return view

    def row(self, episode: int) -> EpisodeRow:
        """Where an episode is and how it came about.

        Raises:
            UsageError: There is none of this number.
        """
        if not 0 <= episode < len(self.rows):
            raise UsageError(f"{shown(self.name)} has no episode {shown(episode)}; it has 0 to {len(self) - 1}.")
        return self.rows[episode]

    def video(self, episode: int, room: Room | None = None) -> UInt8[np.ndarray, "t h w 3"]:
        """An episode's frames, RGB 0-255: one seek in one file of ``video/``.

        Args:
            episode: Its number.
            room: Where the file's chunks are unpacked; whoever reads many episodes in turn takes the same for all.
        """
        row = self.row(episode)
        return self._read(VIDEO, row, lambda file: read_video(file, row.video, self.spec, row.frames, room))

    def states(self, episode: int) -> StateLabels:
        """An episode's labels without its masks, which take most of the time to read.

        Raises:
            LabelsNotAvailable: ``labels/`` is not there.
        """
        row = self.row(episode)
        self._require_labels(row)
        stored = self.manifest.spec  # its actions are those in the file
        states = self._read(LABELS, row, lambda file: read_states(file, row.states, stored, row.frames))
        return states if self._numbers is None else replace(states, actions=self._numbers[states.actions])

    def labels(self, episode: int) -> EpisodeLabels:
        """The labels of an episode.

        Raises:
            LabelsNotAvailable: ``labels/`` is not there.
        """
        row, states = self.row(episode), self.states(episode)

        def read_masks(file: Path) -> UInt8[np.ndarray, "t h w"]:
            masks = np.empty((row.frames, self.spec.height, self.spec.width), np.uint8)
            decode_masks(read_messages(file, row.masks, chunk_limit=chunk_limit(self.spec)), masks)
            return masks

        masks = self._read(LABELS, row, read_masks)
        return EpisodeLabels(
            actions=states.actions,
            pushed=states.pushed,
            agent=states.agent,
            objects=states.objects,
            masks=masks,
            factors=states.factors,
        )

    def fetch(self, episodes: Iterable[int]) -> None:
        """Have the video of some episodes on this machine, where it is on object storage.

        Raises:
            PlaceUnreachable: The storage does not answer.
        """
        if self.remote is not None:
            for shard in dict.fromkeys(self.rows.columns["shard"][list(episodes)].tolist()):
                self.remote.shard(VIDEO, shard, self.manifest)

    def _require_labels(self, row: EpisodeRow) -> None:
        if row.states.size == 0:
            raise LabelsNotAvailable(f"{str(self.where)!r} was imported without labels; only its video can be used.")
        if self.remote is not None:
            try:
                self._file(LABELS, row.shard)
            except FileNotFoundError:
                raise LabelsNotAvailable(
                    f"the labels of {self.remote.address!r} are not there; put the folder {LABELS}/ there, too."
                ) from None
        elif not (file := shard_path(self.path, LABELS, row.shard)).is_file():
            raise LabelsNotAvailable(
                f"the labels of {str(self.path)!r} are not there: no {str(file)!r}; restore the folder "
                f"{LABELS}/ or make it again with {command('dmbench data repair', self.path)}."
            )

    def _file(self, kind: str, shard: int) -> Path:
        if self.remote is None:
            return shard_path(self.path, kind, shard)
        return self.remote.shard(kind, shard, self.manifest)

    def _read(self, kind: str, row: EpisodeRow, read: Callable[[Path], Read]) -> Read:
        """What ``read`` finds in a shard's file."""
        for again in range(_FETCHED_AGAIN, -1, -1):
            file = shard_path(self.path, kind, row.shard)
            try:
                return read(self._file(kind, row.shard))
            except FileNotFoundError as damage:
                if self.remote is None or not again or file.is_file():
                    raise corrupt(self.where, file, damage) from None
            except (DamagedFile, MemoryError) as damage:
                raise corrupt(self.where, file, damage) from None
        raise AssertionError("the last time is not followed by another")

    def episode(self, episode: int) -> Episode:
        """An episode, its video and its labels."""
        row = self.row(episode)
        return Episode(frames=self.video(episode), labels=self.labels(episode), seed=row.seed, ended=row.ended)

    @functools.cached_property
    def _splits(self) -> dict[SplitName, Int[np.ndarray, " n"]]:
        return split_episodes(self.recipe.seed, len(self.rows), self.rows.sources)

    def split(self, name: SplitName) -> Int[np.ndarray, " n"]:
        """The episodes of a split: 10% test, 10% of the rest validation; seed, size and sources alone decide."""
        if name not in SPLIT_NAMES:
            raise UnknownName("split", name, SPLIT_NAMES)
        return self._splits[name]

    def tasks(self) -> list[ControlTask]:
        """The control tasks, the same for every model."""
        try:
            return read_tasks(self.path, self.manifest, self.lengths)
        except DamagedFile as damage:
            raise corrupt(self.where, self.path / TASKS, damage) from None

    def cache(self) -> FrameCache:
        """All frames, memory-mapped; made on first use, and when the data set has changed or the cache is damaged.

        Raises:
            CacheNotWritable: It has to be made and its folder can take no file.
            StorageFull: There is no space for it.
        """
        if self._cache is None:
            self._cache = FrameCache(self.cache_file, self.lengths, self._make_cache)
        return self._cache

    @property
    def cache_file(self) -> CacheFile:
        """The file of the frame cache, if it exists."""
        return CacheFile(
            folder=cache_folder(self.path),
            fingerprint=self.fingerprint,
            count=int(self.lengths.sum()),
            height=self.spec.height,
            width=self.spec.width,
        )

    def _make_cache(self) -> None:
        file = self.cache_file
        file.build(self)
        if file.folder == self.path / CACHE:
            file.remove_others()


def corrupt(dataset: Path | str, file: Path, damage: object) -> DatasetCorrupt:
    """The error for a damaged file of a data set, with the commands that help."""
    check, repair = (command("dmbench data", verb, dataset) for verb in ("check", "repair"))
    known: dict[type, str] = {FileNotFoundError: "is missing", MemoryError: "does not fit into memory"}
    said = known.get(type(damage), damage)
    if isinstance(dataset, str):
        return DatasetCorrupt(
            f"{str(file)!r}, the copy of a file of {shown(dataset)}, is damaged: it {said}. Delete it, and it is "
            f"fetched again; see what is damaged there with {check}."
        )
    return DatasetCorrupt(f"{str(file)!r} is damaged: it {said}. See what else is with {check}, mend it with {repair}.")
