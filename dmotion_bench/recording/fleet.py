"""Importing many recordings beside each other, by an executor; damaged ones may be skipped.

The recordings are looked through (``surveys.py``); then each job makes some shards of the data set. It has the bytes of
an import in one process. What is finished stays beside its place until all is there, so an import that was interrupted
goes on.

A damaged recording that is skipped is as good as not named: the data set is that of the others. Of recordings that hold
several episodes, only the damaged ones are skipped. Some damage shows only when pictures are unpacked; then all that
has such damage is left out together, and the shards made anew.
"""

from __future__ import annotations

import contextlib
import itertools
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from dmotion_bench import versions
from dmotion_bench.errors import RecipeMismatch, RecordingImportError
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.recording.surveys import Surveyed, looked_through
from dmotion_bench.specs import DatasetRecipe, EnvSpec
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.import_plan import ImportPlan, PlannedEpisode, plan_import
from dmotion_bench.storage.imports.importing import (
    UNFINISHED,
    Progress,
    footage,
    require_same,
    skipped_episodes,
    standing_in,
)
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.picture_sizes import have_one_shape, usual_size
from dmotion_bench.storage.imports.recording import Recording
from dmotion_bench.storage.imports.search import find
from dmotion_bench.storage.imports.sources import Source, open_recording, require_effect
from dmotion_bench.storage.shard import Footage, ShardReceipt, shard_range, write_shard
from dmotion_bench.storage.staging import staged, sweep
from dmotion_bench.storage.writer import DatasetWriter

MOST_PARTS: Final = 64
"""Jobs into which the shards are divided; each opens its recordings anew, so many small ones cost more."""


SegmentNumber = tuple[int, int]
"""Of a recording, and of a segment in it."""


@dataclass(frozen=True, kw_only=True)
class ShardsJob:
    """Some shards to be made, with all that decides their bytes.

    Attributes:
        dataset: The folder.
        recipe, spec: Of the data set.
        shards: Numbers of shards that follow each other.
        made: Those of them that are there already; they are only unpacked, since a damaged picture of the next one is
            the picture before it.
        episodes: Those of the shards, in their order.
        sources: The recordings that they are of, by their numbers.
        options: Of the import.
        keep_times: See ``ImportPlan.keeps_times``.
        versions: Of packages, which the data set states; None: any will do.
        progress: The file in which the job says how far it is; None: nowhere.
    """

    dataset: Path
    recipe: DatasetRecipe
    spec: EnvSpec
    shards: tuple[int, ...]
    made: frozenset[int] = frozenset()
    episodes: tuple[PlannedEpisode, ...]
    sources: dict[int, Source]
    options: ImportOptions
    keep_times: bool
    versions: Mapping[str, str] | None = None
    progress: Path | None = None


@dataclass(frozen=True, kw_only=True)
class ShardsMade:
    """The shards of a job.

    Attributes:
        receipts: Of those that are made.
        faults: Why a segment cannot be unpacked, by the numbers of its recording and of itself.
        unreadable: Damaged pictures by the number of their recording, in whose place the ones before them were taken.
    """

    receipts: tuple[ShardReceipt, ...]
    faults: dict[SegmentNumber, RecordingImportError]
    unreadable: dict[int, int]


def shards_job(job: ShardsJob) -> ShardsMade:
    """Make shards in the present process; those of recordings that cannot be unpacked are left out.

    Raises:
        DatasetError: This machine has other versions of packages than the data set states.
    """
    versions.require_same(job.versions or {})
    told, receipts = ProgressFile(job.progress), list[ShardReceipt]()
    waiting = iter(job.episodes)
    try:
        with Confinement(job.options) as confinement:
            unpacking = _Unpacking(job, confinement)
            for done, shard in enumerate(job.shards):
                told.tell(JobProgress(what=f"importing shard {shard}", done=done, total=len(job.shards)))
                planned = [next(waiting) for _ in shard_range(job.recipe, shard)]
                unpacking.begin()
                is_sound = unpacking.faults.keys().isdisjoint(map(_segment, planned))
                if is_sound and shard not in job.made:
                    with contextlib.suppress(RecordingImportError):
                        episodes = unpacking.episodes(planned)
                        receipts.append(write_shard(job.dataset, job.recipe, job.spec, shard, episodes))
                unpacking.look_through(planned)
    finally:
        told.end()
    return ShardsMade(receipts=tuple(receipts), faults=unpacking.faults, unreadable=unpacking.unreadable)


def _segment(planned: PlannedEpisode) -> SegmentNumber:
    return planned.recording, planned.segment


class _Unpacking:
    """Unpacks the episodes of a job, and notes which segments it cannot unpack.

    Attributes:
        faults: Why, by the numbers of the segment.
    """

    def __init__(self, job: ShardsJob, confinement: Confinement) -> None:
        self._job, self._confinement = job, confinement
        self._opened: dict[int, Recording] = {}
        self._running: dict[SegmentNumber, Iterator[Footage]] = {}
        self._through: set[SegmentNumber] = set()
        self.faults: dict[SegmentNumber, RecordingImportError] = {}

    @property
    def unreadable(self) -> dict[int, int]:
        """Damaged pictures, by the number of their recording."""
        return {number: recording.unreadable for number, recording in self._opened.items()}

    def begin(self) -> None:
        """Another shard begins."""
        self._through.clear()

    def episodes(self, planned: Sequence[PlannedEpisode]) -> Iterator[Footage]:
        """Some episodes in their order.

        Raises:
            RecordingImportError: One cannot be unpacked; it is noted, too.
        """
        for segment, count in Counter(map(_segment, planned)).items():
            try:
                yield from itertools.islice(self._footage(segment), count)
            except RecordingImportError as error:
                self.faults[segment] = error
                self._opened.clear()  # what reads them may be gone, or in the middle of an answer
                self._confinement.close()
                raise
            self._through.add(segment)

    def look_through(self, planned: Sequence[PlannedEpisode]) -> None:
        """Unpack what the last shard has not come to, so that one pass finds all damage."""
        for segment in dict.fromkeys(map(_segment, planned)):
            if segment not in self._through and segment not in self.faults:
                with contextlib.suppress(RecordingImportError):
                    for _ in self.episodes([one for one in planned if _segment(one) == segment]):
                        pass

    def _footage(self, segment: SegmentNumber) -> Iterator[Footage]:
        """What is left of a segment's episodes; one pass through it serves all shards of the job."""
        if segment not in self._running:
            own = [one for one in self._job.episodes if _segment(one) == segment]
            opened, by_source = {segment[0]: self._recording(segment[0])}, self._job.recipe.splits_by_source
            self._running[segment] = footage(
                opened, own, self._job.options, keep_times=self._job.keep_times, by_source=by_source
            )
        return self._running[segment]

    def _recording(self, number: int) -> Recording:
        if number not in self._opened:
            recording = open_recording(self._job.sources[number], self._job.options, self._confinement)
            recording.survey()  # it finds where the pictures are
            self._opened[number] = recording
        return self._opened[number]


def import_fleet(
    paths: Sequence[Path],
    out: Path,
    options: ImportOptions,
    executor: Executor | None = None,
    *,
    skip_damaged: bool = False,
    progress: Progress = lambda what, done, total: None,
    jobs: Path | None = None,
) -> ImportReport:
    """Make a data set of foreign recordings, several at a time.

    Args:
        paths, out, options: See ``import_recordings``.
        executor: Runs the jobs; all its machines see the recordings and the folder under the same paths.
        skip_damaged: Leave out recordings that cannot be imported, and those whose pictures have other proportions
            than most have; of recordings that hold several episodes, such episodes. The report says which and why.
        progress: Is told how far all jobs together are.
        jobs: A folder in which the jobs say how far they are (``job_progress.watching``); None: nowhere.

    Raises:
        RecordingImportError: A recording cannot be imported; with ``skip_damaged`` only if none can.
        RecipeMismatch: The folder holds another data set.
        DatasetError: A machine that makes shards has other versions of packages than this one.
        InvalidSetting: An option has no effect for these recordings.
        UsageError: The folder holds something else.
    """
    standing, executor = standing_in(out), executor or SerialExecutor()
    options = replace(options, skip_damaged=skip_damaged)
    unreadable: dict[int, int] = {}
    skipped: dict[Path, RecordingImportError] = {}
    absolute = [path.absolute() for path in paths]
    named = find(absolute, options.camera, salvage=options.salvage, skip_damaged=skip_damaged)
    if not skip_damaged:
        named.require_sound()
    require_effect(named.sources, options)
    skipped |= named.faults
    found = looked_through(named.sources, options, executor, progress, jobs)
    while True:
        sound = _sound(found, skip_damaged, skipped)
        plan = plan_import(sound, [one.survey for one in sound if one.survey is not None], options, named)
        if standing is not None:
            require_same(standing, plan, out)
            break
        faults, unreadable = _written(out, plan, sound, options, executor, progress, jobs)
        if not faults:
            break
        if not skip_damaged:
            sweep(out, UNFINISHED)  # the same would happen again
            raise faults[min(faults)]
        found = list(_without(sound, faults, skipped))
    told = tuple((str(path), str(error)) for path, error in sorted(skipped.items()))
    told += skipped_episodes(sound, plan.surveys)
    return plan.report(out, unreadable=sum(unreadable.values()), skipped=told)


def _without(
    sound: Sequence[Surveyed],
    faults: Mapping[SegmentNumber, RecordingImportError],
    skipped: dict[Path, RecordingImportError],
) -> Iterator[Surveyed]:
    """The recordings without the segments that cannot be unpacked; one of which none is left is noted."""
    for number, one in enumerate(sound):
        assert one.survey is not None
        damaged = {segment: error for (recording, segment), error in faults.items() if recording == number}
        left = one.survey.without({segment: str(error) for segment, error in damaged.items()})
        if left.segments:
            yield replace(one, survey=left) if damaged else one
        else:
            skipped[one.path] = damaged[min(damaged)]


def _sound(found: Sequence[Surveyed], skip: bool, skipped: dict[Path, RecordingImportError]) -> list[Surveyed]:
    """The recordings that can be imported together; what cannot is noted, or raised."""
    for one in found:
        if one.fault is not None:
            if not skip:
                raise one.fault
            skipped[one.path] = one.fault
    sound = [one for one in found if one.fault is None]
    if not sound:
        raise RecordingImportError(
            f"none of the {len(skipped)} recordings can be imported; the first one: {next(iter(skipped.values()))}"
        )
    if not skip:
        return sound
    (width, height), most = usual_size([one.survey for one in sound if one.survey is not None])
    for one in sound:
        size = (width, height) if one.survey is None else (one.survey.width, one.survey.height)
        if not have_one_shape(size, (width, height)):
            skipped[one.path] = RecordingImportError(
                f"{str(one.path)!r} has pictures of {size[0]}x{size[1]} pixels, and {most} of the recordings have "
                f"{width}x{height}, which are other proportions."
            )
    return [one for one in sound if one.path not in skipped]


def _written(
    out: Path,
    plan: ImportPlan,
    sound: Sequence[Surveyed],
    options: ImportOptions,
    executor: Executor,
    progress: Progress,
    jobs: Path | None,
) -> tuple[dict[SegmentNumber, RecordingImportError], dict[int, int]]:
    """Write what is missing beside ``out`` and move it there; else why segments cannot be unpacked.

    Returns:
        That, and the damaged pictures of each recording.
    """
    faults: dict[SegmentNumber, RecordingImportError] = {}
    unreadable = {number: one.unreadable for number, one in enumerate(sound)}
    with (
        contextlib.suppress(_Faulty),
        staged(out, UNFINISHED, keep=True) as folder,
        _writer(folder, plan) as writer,
    ):
        total = plan.recipe.episodes
        done = total - sum(len(writer.episodes_of(shard)) for shard in writer.missing)
        progress("importing", done, total)
        results = executor.map_unordered(shards_job, _parts(writer, plan, sound, options, jobs))
        with contextlib.closing(results):
            for made in results:
                for receipt in made.receipts:
                    writer.add(receipt)
                    done += len(receipt.rows)
                faults |= made.faults
                for number, count in made.unreadable.items():
                    unreadable[number] = max(unreadable[number], count)
                progress("importing", done, total)
        if faults:
            raise _Faulty
        writer.finish()
    return faults, unreadable


class _Faulty(Exception):
    """Leaves the folder before it gets its name."""


def _writer(folder: Path, plan: ImportPlan) -> DatasetWriter:
    """The writer of the data set; what an import of other recordings has left in the folder is deleted."""
    try:
        return DatasetWriter.create_or_resume(folder, plan.recipe, plan.spec)
    except RecipeMismatch:
        for inside in folder.iterdir():
            shutil.rmtree(inside) if inside.is_dir() else inside.unlink()
        return DatasetWriter.create_or_resume(folder, plan.recipe, plan.spec)


def _parts(
    writer: DatasetWriter,
    plan: ImportPlan,
    sound: Sequence[Surveyed],
    options: ImportOptions,
    jobs: Path | None,
) -> list[ShardsJob]:
    """The missing shards in parts; with ``salvage`` all shards in one, where a damaged picture is the one before it."""
    missing = writer.missing
    size = -(-len(missing) // MOST_PARTS)
    parts = [tuple(missing[first : first + size]) for first in range(0, len(missing), size or 1)]
    if options.salvage and missing:
        parts = [tuple(range(max(missing) + 1))]
    made = []
    for number, shards in enumerate(parts):
        episodes = tuple(plan.episodes[one] for shard in shards for one in shard_range(plan.recipe, shard))
        made.append(
            ShardsJob(
                dataset=writer.path.absolute(),
                recipe=plan.recipe,
                spec=plan.spec,
                shards=shards,
                made=frozenset(shards) - frozenset(missing),
                episodes=episodes,
                sources={one.recording: sound[one.recording].source for one in episodes},
                options=options,
                keep_times=plan.keeps_times,
                versions=writer.versions,
                progress=None if jobs is None else jobs / f"shards-{number}.json",
            )
        )
    return made
