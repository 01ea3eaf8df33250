"""Recordings of other systems become a data set, and a data set one of another tool."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, SupportsIndex

from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.settings import EXECUTORS, number, require_one_of, whole
from dmotion_bench.errors import UsageError
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.executor import JobSize
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress, jobs_folder, watching
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot import ExportReport, export_lerobot, has_labels
from dmotion_bench.storage.imports.continuous_commands import Reduce
from dmotion_bench.storage.imports.fitting import Fit
from dmotion_bench.storage.imports.importing import import_recordings as import_in_turn
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.recording import Clock
from dmotion_bench.storage.imports.sources import SUFFIXES
from dmotion_bench.storage.video.codecs import CODECS
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, AnyPaths, Workspace, as_path, in_workspace, listed

_CLUSTER_GIGABYTES: Final = 8
_CLUSTER_MINUTES: Final = 24 * 60


@in_workspace
def import_recordings(
    recordings: AnyPaths,
    *,
    camera: str | int | None = None,
    actions: str | None = None,
    action_fields: Sequence[str] = (),
    action_reduce: str = "last",
    size: SupportsIndex = 128,
    hz: float = 10.0,
    source_hz: float | None = None,
    fit: str = "crop",
    clock: str = "log",
    max_gap_s: float | None = None,
    min_frames: SupportsIndex = 3,
    frames_per_episode: SupportsIndex = 100,
    seed: SupportsIndex = 0,
    salvage: bool = False,
    skip_damaged: bool = False,
    max_chunk_mib: SupportsIndex = 1024,
    max_memory_mib: SupportsIndex = 1024,
    out: AnyPath | None = None,
    workers: SupportsIndex | None = 1,
    executor: str = "local",
    workspace: AnyPath | None = None,
    progress: Progress = None,
    watch: Callable[[Mapping[str, JobProgress]], None] = lambda jobs: None,
) -> ImportReport:
    """Make a data set from recordings: videos, pictures, MCAP (foxglove, ROS 2), HDF5 (robomimic) or LeRobot data sets.

    The times and sizes of all recordings are checked first. If one cannot be imported, nothing is written.

    Args:
        recordings: Files, folders of such files, folders of pictures, or LeRobot data sets; one or several.
        camera: Topic (MCAP), feature (LeRobot), path (HDF5), folder or names such as ``img#_left.png`` (pictures) of
            the camera; of videos the name of the files without suffix, or the number of the stream. Default: the only
            one.
        actions: Topic, feature or path with the actions; they become labels. Default: import video alone.
        action_fields: Fields with the numbers of continuous actions. Default: all numbers of LeRobot's and HDF5's.
        action_reduce: How several continuous commands between two frames become one action: ``"last"``, the
            command in force halfway; ``"mean"``; or ``"sum"``.
        size: Height and width of the frames [px].
        hz: Frames per second of the data set.
        source_hz: Pictures per second of a recording without times, or in place of a video's times. Default: what the
            file says, else ``hz``.
        fit: How a picture that is not square is made square: ``"crop"``, ``"pad"`` or ``"stretch"``.
        clock: Time of a frame: ``"log"``, when it was logged, or ``"header"``, the time stamp in its header.
        max_gap_s: Seconds without a picture that end an episode. Default: 2.5 intervals of the camera, but at least 1.5
            and at most 20 frames at ``hz``.
        min_frames: Episodes with fewer frames are left out.
        frames_per_episode: Longer episodes are cut into parts of equal length.
        seed: Of the split into training, validation and test.
        salvage: Import the undamaged beginning of a damaged file, and repeat the last picture for a damaged one.
        skip_damaged: Leave out recordings, and episodes of HDF5 files and LeRobot data sets, that cannot be imported or
            have pictures of other proportions than most.
        max_chunk_mib: Largest size of a decompressed chunk of an MCAP file [MiB].
        max_memory_mib: Most memory to decode a video with [MiB].
        out: The data set's folder; ``data/imported-NAME`` of the workspace by default.
        workers: How many recordings are read at a time; None: as many as there are processors and memory for. More
            than one need ``if __name__ == "__main__":`` in a script. The bytes are the same for any number.
        executor: Where they are read: ``"local"``, ``"ray"`` or ``"slurm"``.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how far it is, or True for a bar.
        watch: A function that is told, now and then and by another thread, how far the jobs of an executor are, by
            their names.

    Returns:
        What was imported, with advice; it can be given to every function that takes a data set.

    Raises:
        RecordingImportError: A recording cannot be imported.
        RecipeMismatch: The folder holds another data set.
        UnknownName, UsageError, InvalidSetting: A name or a value that is not allowed.

    Example:
        >>> exported = dm.export_dataset("grid_world-tiny", out="recordings/grid")
        >>> imported = dm.import_recordings("recordings/grid", actions="action", out="data/again")
        >>> imported.episodes, imported.frames, imported.actions.names
        (20, 240, ('up', 'down', 'left', 'right'))
    """
    for option, value, allowed in (
        ("fit", fit, Fit),
        ("clock", clock, Clock),
        ("action-reduce", action_reduce, Reduce),
        ("executor", executor, EXECUTORS),
    ):
        require_one_of(option, value, map(str, allowed))
    options = ImportOptions(
        camera=str(camera) if type(camera) is int else _name("camera", camera),
        actions=_name("actions", actions),
        action_fields=_names("action_fields", action_fields),
        action_reduce=Reduce(action_reduce),
        size=whole("size", size),
        hz=number("hz", hz),
        fit=Fit(fit),
        clock=Clock(clock),
        max_gap_s=number("max_gap_s", max_gap_s),
        min_frames=whole("min_frames", min_frames),
        frames_per_episode=whole("frames_per_episode", frames_per_episode),
        seed=whole("seed", seed),
        salvage=salvage,
        source_hz=number("source_hz", source_hz),
        limits=ImportLimits(
            chunk_bytes=whole("max_chunk_mib", max_chunk_mib, 1) * MIB,
            reader_bytes=whole("max_memory_mib", max_memory_mib, 64) * MIB,
        ),
    )
    workers = whole("workers", workers, 1)
    place = Workspace.current()
    paths = [as_path("recording", one) for one in listed(recordings)]
    folder = default_folder(paths, place) if out is None else as_path("folder", out)
    with telling(progress) as tell:

        def say(what: str, done: int, total: int) -> None:
            tell(JobProgress(what=what, done=done, total=total))

        if executor == "local" and workers == 1 and not skip_damaged:
            return import_in_turn(paths, folder, options, say)
        if executor == "local" and workers is None:
            workers = available_workers(options.limits.reader_bytes / 2**30)
        job = JobSize(gigabytes=_CLUSTER_GIGABYTES, minutes=_CLUSTER_MINUTES)
        meeting = place if out is None else Workspace(folder.absolute().parent)
        with jobs_folder(meeting) as jobs, watching(jobs, watch):
            hands = make_executor(executor, workers, scratch=jobs / executor, size=job)
            return import_fleet(paths, folder, options, hands, skip_damaged=skip_damaged, progress=say, jobs=jobs)


def default_folder(recordings: Sequence[Path], workspace: Workspace) -> Path:
    """Where an import goes if nobody names a folder: it is called as the first recording.

    Raises:
        UsageError: There is no recording.
    """
    if not recordings:
        raise UsageError("no recording was named; give files or folders of recordings.")
    return workspace.data / f"imported-{_plain(recordings[0])}"


def _name(argument: str, given: object) -> str | None:
    """A text, or None.

    Raises:
        UsageError: It is neither.
    """
    if given is not None and not isinstance(given, str):
        raise UsageError(f"{argument} is {shown(given)}; it must be a text.")
    return given


def _names(argument: str, given: object) -> tuple[str, ...]:
    """Some texts, of which one alone may stand for itself.

    Raises:
        UsageError: They are something else.
    """
    names = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    if not all(isinstance(name, str) for name in names):
        raise UsageError(f"{argument} is {shown(given)}; it must be a list of texts, such as ['linear.x'].")
    return names


def _plain(path: Path) -> str:
    """A file's name as a folder's name: letters, digits, dots, dashes, and no suffix of a recording."""
    name = path.resolve().name
    if path.is_file():
        name = name[: -max((len(suffix) for suffix in SUFFIXES if name.lower().endswith(suffix)), default=0) or None]
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "recording"


@in_workspace
def export_dataset(
    data: AnyPath | None = None,
    *,
    codec: str = "h264",
    labels: bool | None = None,
    out: AnyPath | None = None,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> ExportReport:
    """Write a data set in LeRobot's format v3, Parquet and video, which is decoded again to measure the codec's loss.

    Args:
        data: The data set, by folder or name, or what ``record`` returned. Default: the workspace's only one.
        codec: ``"h264"`` keeps every pixel; ``"av1"`` is LeRobot's default, smaller and lossy.
        labels: Whether actions and positions are written; None: where there are any.
        out: The folder to write; ``exports/NAME-lerobot`` of the workspace by default.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how far it is, or True for a bar.

    Raises:
        DatasetMissing, DatasetCorrupt: There is no such data set, or it is damaged.
        LabelsNotAvailable: Labels were asked for and are not there.
        UsageError: The folder is there already, or the codec cannot take such frames.

    Example:
        >>> exported = dm.export_dataset("grid_world-tiny", out="exports/grid")
        >>> exported.episodes, exported.labels, exported.mse
        (20, True, 0.0)
    """
    require_one_of("codec", codec, CODECS)
    place = Workspace.current()
    source = Dataset.open(place.dataset(data))
    folder = place.root / "exports" / f"{source.name}-lerobot" if out is None else as_path("folder", out)
    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder talks on stderr, past every log
    with telling(progress) as tell:

        def say(what: str, done: int, total: int) -> None:
            tell(JobProgress(what=what, done=done, total=total))

        with_labels = has_labels(source) if labels is None else labels
        return export_lerobot(source, folder, codec=CODECS[codec], labels=with_labels, progress=say)
