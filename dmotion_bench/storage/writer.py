"""Writing a data set, shard by shard: new, resumed after any interruption, or extended.

Nothing but the shards themselves remembers how far a recording is: a shard that has its final name is whole
and describes itself, so a killed recording goes on from what it finds.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType

from dmotion_bench.errors import DatasetError, RecipeMismatch, UsageError
from dmotion_bench.specs import IMPORTED, DatasetRecipe, EnvSpec, Episode
from dmotion_bench.storage.atomic import is_unused, remove_leftovers
from dmotion_bench.storage.lock import ANOTHER_FOLDER, FolderLock
from dmotion_bench.storage.manifest import Manifest, Replay, ShardEntry, record_words
from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.shard import (
    LABELS,
    VIDEO,
    EpisodeRow,
    Footage,
    ShardReceipt,
    file_facts,
    scan_shard,
    shard_count,
    shard_path,
    shard_range,
    write_shard,
)
from dmotion_bench.storage.split import split_episodes
from dmotion_bench.storage.tables import EPISODES, TASKS, EpisodeTable, write_episodes, write_tasks
from dmotion_bench.storage.tasks import tasks_of
from dmotion_bench.versions import versions, with_earlier
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import DATASET_MANIFEST

_PACKAGES = ("dmbench", "numpy", "zstandard", "gymnasium", "pymunk", "pybullet")
"""What decides the bytes of a recording beside its recipe."""
_GROWS = ("episodes", "tasks")  # what a second recording into the same folder may change


class DatasetWriter:
    """Writes a data set; holds the folder's lock until its ``with`` block ends.

    Attributes:
        path, recipe, spec: Of the data set.
        missing: The shards that are still to be written.
        versions: Of the packages, which ``dataset.json`` states.
    """

    def __init__(
        self,
        path: Path,
        recipe: DatasetRecipe,
        spec: EnvSpec,
        receipts: Iterable[ShardReceipt],
        lock: FolderLock,
        packages: tuple[str, ...] = (),
    ) -> None:
        self.path, self.recipe, self.spec = path, recipe, spec
        self.versions = versions((*_PACKAGES, *(name for name in packages if name not in _PACKAGES)))
        self._stated = self.versions
        self._begun_here = False
        self._receipts = {receipt.index: receipt for receipt in receipts}
        self._lock: FolderLock | None = lock
        self._standing: Manifest | None = None

    @classmethod
    def create_or_resume(
        cls, path: Path, recipe: DatasetRecipe, spec: EnvSpec, packages: tuple[str, ...] = ()
    ) -> DatasetWriter:
        """Start a new data set, or continue the one in the folder.

        Args:
            path: The folder.
            recipe, spec: Of the data set.
            packages: Whose versions also stand in ``dataset.json``.

        Raises:
            RecipeMismatch: What stands there was made by another recipe, or is larger, or has more control tasks.
            InvalidSetting: There can be no such data set.
            UsageError: The folder holds something else.
        """
        begun = Manifest(recipe=recipe, spec=spec, versions=versions((*_PACKAGES, *packages)))
        begun.require_possible()
        try:
            path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise UsageError(
                f"{str(path)!r} cannot be a folder, a file is in the way; name another folder with '--out DIR'."
            ) from None
        lock = FolderLock(path, ANOTHER_FOLDER)
        try:
            existing = _is_begun(path)  # looked at here, where nobody else writes
            receipts: list[ShardReceipt] = []
            standing: Manifest | None = None
            if existing:
                standing = Manifest.read(path)
                check_recipe(standing, recipe, spec, path)
                receipts = list(_standing_shards(path, recipe, spec, standing))
            _remove_leftovers(path)
            writer = cls(path, recipe, spec, receipts, lock, packages)
            writer._begun_here = not existing
            if not writer.missing:
                writer._standing = standing
            else:
                if standing is not None and receipts:  # of shards that others may have made
                    writer._stated = with_earlier(standing.versions, writer.versions)
                dataclasses.replace(begun, versions=writer._stated).write(path)
        except BaseException:
            lock.release()
            raise
        return writer

    @property
    def missing(self) -> tuple[int, ...]:
        """The numbers of the shards that are still to be written."""
        return tuple(index for index in range(shard_count(self.recipe)) if index not in self._receipts)

    @property
    def frames(self) -> int:
        """Frames in all shards that are whole."""
        return sum(receipt.frames for receipt in self._receipts.values())

    @property
    def bytes(self) -> int:
        """Size of all shards that are whole."""
        files = [file for one in self._receipts.values() for file in (one.video, one.labels)]
        return sum(file.size for file in files if file is not None)

    def episodes_of(self, index: int) -> range:
        """The episodes that belong into a shard."""
        return shard_range(self.recipe, index)

    def write_shard(self, index: int, episodes: Iterable[Episode | Footage]) -> ShardReceipt:
        """Write a shard in this process."""
        receipt = write_shard(self.path, self.recipe, self.spec, index, episodes)
        self.add(receipt)
        return receipt

    def add(self, receipt: ShardReceipt) -> None:
        """Register a shard that another process has written.

        Raises:
            DatasetError: The folder was deleted meanwhile.
        """
        self._require_there()
        self._receipts[receipt.index] = receipt

    def _require_there(self) -> None:
        try:
            if self._lock is None or self._lock.is_on(self.path):
                return
        except OSError:
            pass
        raise deleted(self.path)

    def row(self, episode: int) -> EpisodeRow:
        """Where an episode that is written stands."""
        index = episode // self.recipe.shard_episodes
        return self._receipts[index].rows[episode - self.episodes_of(index)[0]]

    @property
    def complete(self) -> Manifest | None:
        """The manifest in the folder, if it says that the very data set asked for is complete."""
        standing = self._standing
        return standing if standing is not None and standing.complete and standing.recipe == self.recipe else None

    def withdraw(self) -> str:
        """Delete the folder if this writer began it and no shard is whole: there may be no such data set.

        A shard that is whole stays: where one machine of many fails, the work of the others is not lost.

        Returns:
            A sentence that says what is kept.
        """
        if self._receipts:
            kept = sum(len(receipt.rows) for receipt in self._receipts.values())
            return (
                f"{kept:,} of {self.recipe.episodes:,} episodes are recorded and kept; once the cause is mended, the "
                "same command goes on where it stopped."
            )
        if self._begun_here:
            self._delete()
        return "Nothing is recorded."

    def _delete(self) -> None:
        for folder in (VIDEO, LABELS):
            shutil.rmtree(self.path / folder, ignore_errors=True)
        (self.path / DATASET_MANIFEST).unlink(missing_ok=True)
        _remove_leftovers(self.path)
        with contextlib.suppress(OSError):  # somebody put something there meanwhile
            self.path.rmdir()

    def finish(
        self, *, salvaged: bool = False, made_with: Mapping[str, str] | None = None, replay: Replay | None = None
    ) -> Manifest:
        """Write the tables and declare the data set complete; every shard must be there.

        Args:
            salvaged: Whether episodes were lost on the way here.
            made_with: The versions of packages to state; if left out, those that made the shards.
            replay: Whether the recording repeats, if that was tried; one that does not has no control tasks.
        """
        if self.missing:
            raise DatasetError(f"{len(self.missing)} shards of {str(self.path)!r} are still missing.")
        self._require_there()
        _remove_leftovers(self.path)
        if self.complete is not None:
            return self.complete
        receipts = [self._receipts[index] for index in range(shard_count(self.recipe))]
        rows = EpisodeTable.of([row for receipt in receipts for row in receipt.rows])
        possible = [found for receipt in receipts for found in receipt.candidates]
        split = split_episodes(self.recipe.seed, self.recipe.episodes, rows.sources)
        tasks = tasks_of(self.recipe, rows.sources, possible, repeats=replay is None or replay.identical)
        try:
            write_episodes(self.path, rows, split)
            write_tasks(self.path, tasks)
            manifest = Manifest(
                recipe=self.recipe,
                spec=self.spec,
                complete=True,
                salvaged=salvaged,
                versions=made_with or self._stated,
                replay=replay,
                tables={name: file_facts(self.path / name) for name in (EPISODES, TASKS)},
                shards=tuple(
                    ShardEntry(episodes=len(one.rows), frames=one.frames, video=one.video, labels=one.labels)
                    for one in receipts
                ),
            )
            manifest.write(self.path)
        except FileNotFoundError:
            self._require_there()
            raise
        return manifest

    def close(self) -> None:
        """Release the folder's lock."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def deleted(path: Path) -> DatasetError:
    """The error for a folder that went away while it was written into."""
    return DatasetError(
        f"{shown(str(path))} was deleted, moved or replaced while it was written; run the same command again to begin "
        "anew."
    )


def _is_begun(path: Path) -> bool:
    """Whether a folder holds a data set, finished or not.

    Raises:
        UsageError: It holds something else.
    """
    begun = (path / DATASET_MANIFEST).is_file()
    if not begun and not is_unused(path):
        raise UsageError(f"{str(path)!r} is not empty and holds no data set; name another folder with '--out DIR'.")
    return begun


def _remove_leftovers(path: Path) -> None:
    """Delete what killed processes left: earlier ones, or workers of this one."""
    for folder in (path, path / VIDEO, path / LABELS):
        remove_leftovers(folder)


def check_recipe(
    standing: Manifest,
    recipe: DatasetRecipe,
    spec: EnvSpec,
    path: Path | str,
    elsewhere: str = "name another folder with '--out DIR'",
) -> None:
    """See that a data set can become that of a recipe: it is a part of it, or all of it.

    Args:
        standing: The data set.
        recipe, spec: What it is to become.
        path: Where it is.
        elsewhere: How to record in another place.

    Raises:
        RecipeMismatch: It cannot; says what differs.
    """
    if standing.salvaged:
        raise RecipeMismatch(f"{str(path)!r} was repaired and lacks episodes, so it cannot be extended; {elsewhere}.")
    old, new = dataclasses.asdict(standing.recipe), dataclasses.asdict(recipe)
    differing = [
        f"{key} is {shown(old[key])} there and {shown(new[key])} here"
        for key in old
        if old[key] != new[key] and key not in _GROWS
    ]
    if not differing and standing.spec != spec:
        differing = [f"the environment {recipe.environment!r} has changed since"]
    if differing:
        raise RecipeMismatch(
            f"{str(path)!r} holds a data set of another recipe: {'; '.join(differing)}. "
            f"To go on with it: {command(*record_words(standing.recipe, path))}; for a new one {elsewhere}."
        )
    if standing.recipe.episodes > recipe.episodes:
        raise RecipeMismatch(
            f"{str(path)!r} is a data set of {standing.recipe.episodes} episodes, more than the {recipe.episodes} "
            f"asked for; for a smaller one {elsewhere}."
        )
    if standing.recipe.tasks > recipe.tasks:
        raise RecipeMismatch(
            f"{str(path)!r} was recorded with '--tasks {standing.recipe.tasks}', more than the {recipe.tasks} asked "
            f"for; give this option again to keep its control tasks, or {elsewhere}."
        )


def _standing_shards(path: Path, recipe: DatasetRecipe, spec: EnvSpec, standing: Manifest) -> Iterator[ShardReceipt]:
    """The complete shards in the folder that hold all episodes of the recipe's shards, as they were recorded."""
    for index in range(shard_count(recipe)):
        if not shard_path(path, VIDEO, index).is_file():
            continue
        try:
            receipt = scan_shard(path, spec, index)
        except DamagedFile:
            continue  # written anew
        stated = standing.shards[index] if index < len(standing.shards) else None
        if stated is not None and (receipt.video, receipt.labels) != (stated.video, stated.labels):
            continue  # damaged since, or a part of the shard
        labelled = receipt.labels is not None or recipe.environment == IMPORTED
        if labelled and [row.episode for row in receipt.rows] == list(shard_range(recipe, index)):
            yield receipt
