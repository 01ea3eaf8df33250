"""Repair of a data set from its remains; the original stays until the new one is complete.

``rebuild_tables`` makes the tables again from sound shards. ``salvage`` keeps every episode that can be read to
its last frame: of a truncated file each complete chunk is read, in the order of the file, which is what the
official reader's ``NonSeekingReader(log_time_order=False)`` would yield. An episode whose bytes the disk can no longer
read is lost like one whose bytes are wrong. Recording lost shards anew from the recipe, which loses nothing, is
``dmotion_bench.recording.restore``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.errors import DatasetCorrupt, DatasetError, FolderInUse, LabelsNotAvailable, UsageError
from dmotion_bench.storage.check import labels_state
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.limits import MOST_SHARD_EPISODES
from dmotion_bench.storage.lock import FolderLock, held
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.mcap_reader import DamagedFile, Section, list_sections
from dmotion_bench.storage.shard import (
    LABELS,
    VIDEO,
    EpisodeRow,
    Footage,
    episode_row,
    scan_shard,
    shard_path,
    shard_range,
)
from dmotion_bench.storage.tables import EpisodeTable, read_episodes
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.wording import command, shown

_PACKER: Final = "zstandard"
"""The package that packs what is kept anew; the others made what is in it, long before."""
_UNFINISHED = "repairing"
_ORIGINAL = "damaged"
"""Folders beside the data set, one level down, so that the workspace does not list what is in them."""


@dataclass(frozen=True, kw_only=True)
class Salvaged:
    """The result of a salvage.

    Attributes:
        kept: The episodes that could be read, by their old numbers.
        lost: Those that could not.
        original: Where the damaged data set was moved to.
    """

    kept: tuple[int, ...]
    lost: tuple[int, ...]
    original: Path


def rebuild_tables(path: Path, manifest: Manifest) -> None:
    """Make ``episodes.parquet`` and ``tasks.parquet`` again; all shards must be sound.

    Raises:
        DamagedFile: A shard is not.
    """
    receipts = [
        scan_shard(path, manifest.spec, index, labelled=entry.labels is not None)
        for index, entry in enumerate(manifest.shards)
    ]
    with DatasetWriter(path, manifest.recipe, manifest.spec, receipts, FolderLock(path)) as writer:
        writer.finish(salvaged=manifest.salvaged, made_with=manifest.versions, replay=manifest.replay)


def salvage(path: Path) -> Salvaged:
    """Replace a data set by a new one with everything that can still be read, and keep the old one beside it.

    The new one names the packages that made the old one. Where the recording did not repeat, it has no control tasks.

    Raises:
        DatasetCorrupt: Nothing can be read, or an earlier repair's original is still there.
        UsageError: Something that no repair left is in the way.
    """
    path = path.resolve()
    manifest = Manifest.read_complete(path)
    original = path.parent / _ORIGINAL / path.name
    if original.exists():
        raise DatasetCorrupt(
            f"{str(original)!r}, the original of an earlier repair, is still there; move or delete it, then run "
            f"{command('dmbench data repair', path)} again."
        )
    with held(path):
        listed = list(_listed_episodes(path, manifest))
        damaged = Dataset(path, manifest, EpisodeTable.of(listed))
        labelled = labels_state(path, manifest) == "present"
        kept = [place for place in range(len(listed)) if _readable(damaged, place, labelled)]
        if not kept:
            raise DatasetCorrupt(
                f"not one episode of {str(path)!r} can be read; record it anew with 'dmbench record' "
                "into another folder, or restore it from a copy."
            )
        unfinished = path.parent / _UNFINISHED / path.name
        _clear(unfinished)
        repeats = manifest.replay is None or manifest.replay.identical  # else a task could not be begun
        tasks = manifest.recipe.tasks if repeats else 0
        recipe = dataclasses.replace(manifest.recipe, episodes=len(kept), tasks=tasks)
        with DatasetWriter.create_or_resume(unfinished, recipe, manifest.spec) as writer:
            for index in writer.missing:
                places = [kept[number] for number in shard_range(recipe, index)]
                writer.write_shard(index, (_footage(damaged, place, labelled) for place in places))
            packed = {_PACKER: writer.versions[_PACKER]} if _PACKER in writer.versions else {}
            writer.finish(salvaged=True, made_with={**manifest.versions, **packed})
        original.parent.mkdir(exist_ok=True)
        path.rename(original)
        try:
            unfinished.rename(path)
        except BaseException:
            original.rename(path)
            raise
        _remove_if_empty(unfinished.parent)
    numbers = {listed[place].episode for place in kept}
    return Salvaged(
        kept=tuple(sorted(numbers)),
        lost=tuple(number for number in range(manifest.recipe.episodes) if number not in numbers),
        original=original,
    )


def finish_interrupted(datasets: Path) -> list[Path]:
    """Give salvaged data sets their places whose repair was killed right before: their originals are moved away.

    Args:
        datasets: The folder that they stand in.

    Returns:
        Their places.
    """
    finished = []
    for unfinished in sorted((datasets / _UNFINISHED).glob("*")):
        path, original = datasets / unfinished.name, datasets / _ORIGINAL / unfinished.name
        with contextlib.suppress(DatasetError, FileNotFoundError, FolderInUse), held(original):  # not of one at work
            standing = Manifest.read(unfinished)
            if standing.salvaged and standing.complete and not path.exists():
                unfinished.rename(path)
                finished.append(path)
    if finished:
        _remove_if_empty(datasets / _UNFINISHED)
    return finished


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # not empty: another data set is being repaired
        folder.rmdir()


def _clear(unfinished: Path) -> None:
    """Delete what a repair that was killed left behind, and nothing else."""
    if not unfinished.is_dir() or not any(unfinished.iterdir()):
        return
    try:
        standing = Manifest.read(unfinished)
        left_behind = standing.salvaged or not standing.complete
    except DatasetError:
        left_behind = False
    if not left_behind:
        raise UsageError(f"{shown(str(unfinished))} is in the way of the repair; rename it or move it elsewhere.")
    shutil.rmtree(unfinished)


def _listed_episodes(path: Path, manifest: Manifest) -> Iterator[EpisodeRow]:
    """The expected places of the episodes: from the table or, without it, from the shards."""
    try:
        yield from read_episodes(path, manifest)
    except DamagedFile:
        missing = set(range(manifest.recipe.episodes))
        for index in range(len(manifest.shards)):
            labels = {
                (one.kind, one.values.get("episode")): one.span for one in _sections(shard_path(path, LABELS, index))
            }
            for section in _sections(shard_path(path, VIDEO, index)):
                with contextlib.suppress(DamagedFile):
                    row = episode_row(section, index, manifest.spec)
                    if row.episode not in missing:
                        continue  # a copy of another shard stands in this one's place
                    missing.remove(row.episode)
                    number = section.values["episode"]
                    states, masks = (labels.get((name, number), row.states) for name in ("states", "masks"))
                    yield dataclasses.replace(row, states=states, masks=masks)


def _sections(file: Path) -> list[Section]:
    return list_sections(file, most=2 * MOST_SHARD_EPISODES, salvage=True) if file.is_file() else []


def _readable(dataset: Dataset, place: int, labelled: bool) -> bool:
    try:
        _footage(dataset, place, labelled)
    except (DatasetCorrupt, LabelsNotAvailable):
        return False
    return True


def _footage(dataset: Dataset, place: int, labelled: bool) -> Footage:
    row = dataset.rows[place]
    return Footage(
        frames=dataset.video(place),
        labels=dataset.labels(place) if labelled else None,
        seed=row.seed,
        ended=row.ended,
        start_ns=row.start_ns,
        source=row.source,
    )
