"""Check a data set: every file's hash, every chunk's checksum, and the tables and the cache against the shards."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from dmotion_bench.addresses import remote_address
from dmotion_bench.errors import DatasetCorrupt
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import TABLES, Manifest, ShardEntry
from dmotion_bench.storage.mcap_reader import DamagedFile, lost_is_damaged
from dmotion_bench.storage.remote_copy import RemoteCopy
from dmotion_bench.storage.shard import LABELS, VIDEO, FileFacts, file_facts, scan_shard, shard_path
from dmotion_bench.storage.tables import EPISODES, TASKS, EpisodeTable, read_episodes, read_tasks
from dmotion_bench.storage.tasks import Candidate, tasks_of
from dmotion_bench.workspace import CACHE

LabelsState = Literal["present", "missing", "none"]


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A damage: something that differs from what was recorded.

    Attributes:
        file: Relative to the data set's folder.
        shard: The shard it belongs to; None for a table or the cache.
        what: Says what is wrong with the file: "is missing".
    """

    file: str
    shard: int | None
    what: str


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """The outcome of a check.

    Attributes:
        dataset: The folder.
        manifest: What should be there.
        damages: What is wrong, empty for a sound data set.
        labels: Whether ``labels/`` is there, was taken away as a whole, which is allowed, or never was.
    """

    dataset: Path
    manifest: Manifest
    damages: tuple[Damage, ...]
    labels: LabelsState

    @property
    def cache(self) -> bool:
        """Whether the cache is damaged."""
        return any(damage.file.startswith(f"{CACHE}/") for damage in self.damages)

    @property
    def tables(self) -> bool:
        """Whether a table is damaged."""
        return any(damage.file in TABLES for damage in self.damages)

    @property
    def shards(self) -> tuple[int, ...]:
        """The numbers of the damaged shards."""
        return tuple(sorted({damage.shard for damage in self.damages if damage.shard is not None}))


def labels_state(dataset: Path, manifest: Manifest, remote: RemoteCopy | None = None) -> LabelsState:
    """Whether a data set has labels, never had, or has lost them altogether."""
    if all(shard.labels is None for shard in manifest.shards):
        return "none"
    if remote is not None:
        return "present" if remote.sizes(LABELS) else "missing"
    return "present" if any((dataset / LABELS).glob("*.mcap")) else "missing"


def check_dataset(path: Path, on_progress: Callable[[int, int], None] = lambda _done, _total: None) -> CheckReport:
    """Read everything that a data set holds.

    Args:
        path: Its folder, or its address.
        on_progress: Called with the number of shards that are checked, and of all.
    """
    remote = None if (address := remote_address(path)) is None else RemoteCopy(address)
    damages = list[Damage]()
    if remote is not None:
        remote.refresh()
        path = remote.folder
        damages += _remote_table_damages(remote)
    manifest = Manifest.read_complete(path)
    labels = labels_state(path, manifest, remote)
    there = {} if remote is None else {kind: remote.sizes(kind) for kind in (VIDEO, LABELS)}
    damages += [] if damages else _table_damages(path, manifest)
    rows, possible = _rows(path, manifest), list[Sequence[Candidate]]()
    here = None if rows is None else Dataset(path, manifest, rows)
    for index, entry in enumerate(manifest.shards):
        on_progress(index, len(manifest.shards))
        files = [(VIDEO, entry.video), (LABELS, entry.labels if labels == "present" else None)]
        found = [
            one
            for kind, facts in files
            if facts is not None
            for one in (
                _file_damage(path, kind, index, facts)
                if remote is None
                else _remote_damage(remote, kind, index, manifest, there[kind])
            )
        ]
        found = found or list(_content_damages(path, manifest, here, index, entry, labels, possible))
        damages += found
    on_progress(len(manifest.shards), len(manifest.shards))
    if rows is not None and not damages and labels != "missing":
        damages += _task_damages(path, manifest, rows, possible)
    if rows is not None and not damages:
        damages += cache_damages(Dataset(path, manifest, rows, remote))
    return CheckReport(dataset=path, manifest=manifest, damages=tuple(damages), labels=labels)


def _rows(path: Path, manifest: Manifest) -> EpisodeTable | None:
    try:
        return read_episodes(path, manifest)
    except DamagedFile:
        return None


def _table_damages(path: Path, manifest: Manifest) -> Iterator[Damage]:
    try:
        lengths = read_episodes(path, manifest).lengths
    except DamagedFile as damage:
        yield Damage(file=EPISODES, shard=None, what=str(damage))
        return
    try:
        read_tasks(path, manifest, lengths)
    except DamagedFile as damage:
        yield Damage(file=TASKS, shard=None, what=str(damage))


def _file_damage(path: Path, kind: str, index: int, facts: FileFacts) -> Iterator[Damage]:
    file = shard_path(path, kind, index)
    name = f"{kind}/{file.name}"
    if not file.is_file():
        yield Damage(file=name, shard=index, what="is missing")
    elif file.stat().st_size != facts.size:
        yield Damage(file=name, shard=index, what=f"has {file.stat().st_size} bytes instead of {facts.size}")
    else:
        try:
            with lost_is_damaged():
                is_sound = file_facts(file) == facts
        except DamagedFile as damage:
            yield Damage(file=name, shard=index, what=str(damage))
        else:
            if not is_sound:
                yield Damage(file=name, shard=index, what="has other bytes than were recorded")


def _remote_damage(
    remote: RemoteCopy, kind: str, index: int, manifest: Manifest, there: Mapping[str, int]
) -> Iterator[Damage]:
    """What is wrong with a file of the storage, which lists these sizes; a sound one is here afterwards."""
    file, entry = shard_path(remote.folder, kind, index), manifest.shards[index]
    name, facts = f"{kind}/{file.name}", entry.video if kind == VIDEO else entry.labels
    if facts is not None and there.get(file.name, facts.size) != facts.size:  # no more than its size is ever read
        yield Damage(file=name, shard=index, what=f"has {there[file.name]} bytes instead of {facts.size}")
        return
    try:
        file = remote.shard(kind, index, manifest)
        if file_facts(file) != facts:  # a copy that the disk has spoilt
            file.unlink()
            remote.shard(kind, index, manifest)
    except FileNotFoundError:
        yield Damage(file=name, shard=index, what="is missing")
    except DatasetCorrupt:
        yield Damage(file=name, shard=index, what="has other bytes than were recorded")


def _remote_table_damages(remote: RemoteCopy) -> Iterator[Damage]:
    manifest = Manifest.read_complete(remote.folder)
    try:
        remote.fetch_tables(manifest)
    except DatasetCorrupt as damage:
        yield Damage(file=EPISODES, shard=None, what=f"cannot be had: {damage}")
        return
    there = remote.sizes("")
    for name, facts in manifest.tables.items():
        if there.get(name, facts.size) != facts.size:
            yield Damage(file=name, shard=None, what=f"has {there[name]} bytes instead of {facts.size}")


def _task_damages(
    path: Path, manifest: Manifest, rows: EpisodeTable, possible: Sequence[Sequence[Candidate]]
) -> Iterator[Damage]:
    """Whether the table of tasks is another than sound shards give; the fingerprint would be the same."""
    repeats = manifest.replay is None or manifest.replay.identical
    try:
        standing = read_tasks(path, manifest, rows.lengths)
    except DamagedFile as damage:
        yield Damage(file=TASKS, shard=None, what=str(damage))
        return
    if standing != tasks_of(manifest.recipe, rows.sources, possible, repeats=repeats):
        yield Damage(file=TASKS, shard=None, what="names other tasks than the recordings give")


def table_damages(dataset: Dataset) -> Iterator[Damage]:
    """Tables that say something else than the shards, where these are sound; nothing where the labels are missing."""
    manifest, possible = dataset.manifest, list[Sequence[Candidate]]()
    if labels_state(dataset.path, manifest, dataset.remote) == "missing":
        return
    for index, entry in enumerate(manifest.shards):
        if dataset.remote is not None:  # others may have taken its room meanwhile
            for kind in (VIDEO, LABELS) if entry.labels is not None else (VIDEO,):
                dataset.remote.shard(kind, index, manifest)
        try:
            receipt = scan_shard(dataset.path, manifest.spec, index, labelled=entry.labels is not None)
        except DamagedFile as damage:
            yield Damage(file=f"{VIDEO}/{shard_path(dataset.path, VIDEO, index).name}", shard=index, what=str(damage))
            return
        if dataset.rows.of_shard(index) != list(receipt.rows):
            yield _other_episodes(dataset.path, index)
            return
        possible += receipt.candidates
    yield from _task_damages(dataset.path, manifest, dataset.rows, possible)


def _other_episodes(path: Path, index: int) -> Damage:
    shard = f"{VIDEO}/{shard_path(path, VIDEO, index).name}"
    return Damage(file=EPISODES, shard=None, what=f"describes other episodes than {shard} holds")


def cache_damages(dataset: Dataset) -> Iterator[Damage]:
    """Damages of the frame cache where the video itself is sound."""
    file = dataset.cache_file
    name = f"{CACHE}/{file.path.name}"
    if file.path.is_dir():  # it is in the way of the cache
        yield Damage(file=name, shard=None, what="is a folder")
        return
    if not file.path.is_file() or file.is_unchecked():
        return
    mapped = file.map()
    if mapped is None:
        yield Damage(file=name, shard=None, what="cannot be read")
        return
    first = 0
    for episode, length in enumerate(dataset.lengths.tolist()):
        if not np.array_equal(mapped.frames[first : first + length], dataset.video(episode)):
            yield Damage(file=name, shard=None, what="holds other frames than the video")
            return
        if not all(map(mapped.is_sound, range(first, first + length))):
            yield Damage(file=name, shard=None, what="holds wrong checksums")
            return
        first += length


def _content_damages(
    path: Path,
    manifest: Manifest,
    dataset: Dataset | None,
    index: int,
    entry: ShardEntry,
    labels: LabelsState,
    possible: list[Sequence[Candidate]],
) -> Iterator[Damage]:
    """What is wrong with a shard whose hashes are right: the writer's fault, or a forged dataset.json.

    What could be a control task in its episodes is added to ``possible``.
    """
    name = f"{VIDEO}/{shard_path(path, VIDEO, index).name}"
    try:
        receipt = scan_shard(path, manifest.spec, index, labelled=entry.labels is not None)
    except DamagedFile as damage:
        yield Damage(file=name, shard=index, what=str(damage))
        return
    possible += receipt.candidates
    if (len(receipt.rows), receipt.frames) != (entry.episodes, entry.frames):
        yield Damage(file=name, shard=index, what="holds other episodes than dataset.json says")
    if dataset is None:
        return
    listed = dataset.rows.of_shard(index)
    if labels != "missing" and listed != list(receipt.rows):  # the shard itself is as it was recorded
        yield _other_episodes(path, index)
        return
    for row in listed:
        try:
            dataset.video(row.episode)
            if labels == "present" and row.states.size:
                dataset.labels(row.episode)
        except DatasetCorrupt as error:
            yield Damage(file=name, shard=index, what=f"cannot be read: {error}")
            return
