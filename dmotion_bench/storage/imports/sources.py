"""What somebody names on the command line -> recordings: which kind of thing stands at a path, and who reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, TypedDict

from dmotion_bench.errors import RecordingImportError, UsageError
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.lerobot_layout import INFO
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.mcap_recording import McapRecording
from dmotion_bench.storage.imports.natural_order import in_natural_order
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.passed_over import PassedOver, Taken, is_dataset, passed_over, real_paths
from dmotion_bench.storage.imports.picture_folder import PICTURES, PictureFolder, episode_folders
from dmotion_bench.storage.imports.recording import Clock, Recording
from dmotion_bench.wording import command


class Kind(StrEnum):
    """A container of recordings, one class each."""

    MCAP = "mcap"
    MCAP_VIDEO = "mcap_video"
    VIDEO = "video"
    HDF5 = "hdf5"
    PICTURES = "pictures"
    LEROBOT = "lerobot"


SUFFIXES: Final = {
    ".mcap": Kind.MCAP,
    ".mcap.zst": Kind.MCAP,
    ".mcap.zstd": Kind.MCAP,
    ".mp4": Kind.VIDEO,
    ".m4v": Kind.VIDEO,
    ".mov": Kind.VIDEO,
    ".mkv": Kind.VIDEO,
    ".webm": Kind.VIDEO,
    ".avi": Kind.VIDEO,
    ".hdf5": Kind.HDF5,
    ".h5": Kind.HDF5,
}
"""What is looked for in a folder. A file that is named itself may be called anything: its first bytes decide."""
KNOWN: Final = "MCAP (.mcap, .mcap.zst), video (.mp4 .mov .mkv .webm .avi), HDF5 (.hdf5 .h5)"
_CONVERT: Final = "convert it with 'rosbags-convert --src BAG --dst OUT --dst-storage mcap'"


@dataclass(frozen=True, kw_only=True)
class Source:
    """A recording that is not opened yet."""

    path: Path
    kind: Kind


@dataclass(frozen=True, kw_only=True)
class Found:
    """What somebody has named, before any of it is opened.

    Attributes:
        sources: The recordings, in their order.
        faults: Why a path, or a folder in one, gives no recording.
        told: Sentences about what lies in the folders and is not imported.
        doubts: Of a folder whose pictures may not be those that are meant: why, for the case that they are too few.
    """

    sources: Sequence[Source]
    faults: Mapping[Path, RecordingImportError]
    told: Sequence[str]
    doubts: Mapping[Path, str]

    def require_sound(self) -> None:
        """Check that everything can be imported.

        Raises:
            RecordingImportError: The first fault.
        """
        for fault in self.faults.values():
            raise fault


def find(paths: Sequence[Path], camera: str | None) -> Found:
    """The recordings that are meant: files as they are, folders by what is in them.

    Args:
        paths: Files and folders.
        camera: The camera that was asked for; in folders of pictures it is a folder.

    Raises:
        UsageError: A recording is named twice.
    """
    sources: list[Source] = []
    faults: dict[Path, RecordingImportError] = {}
    for path in paths:
        try:
            sources += _at(path, camera, faults)
        except RecordingImportError as error:
            faults[path] = error
        except OSError as error:
            faults[path] = _unreadable(path, error)
    require_once(sources)
    taken = _taken(sources, camera)
    over = [passed_over(path, taken, (*SUFFIXES, *PICTURES), INFO) for path in paths if _is_told_of(path, faults)]
    pictures = {source.path for source in sources if source.kind is Kind.PICTURES}
    return Found(
        sources=sources,
        faults=faults,
        told=[sentence for one in over for sentence in one.sentences(camera)],
        doubts={one.folder: _doubt(one) for one in over if one.readable and one.folder in pictures},
    )


def sources_in(paths: Sequence[Path], camera: str | None) -> Sequence[Source]:
    """The recordings that are meant, all of which must be there; see ``find``.

    Raises:
        RecordingImportError: A path is not there, or holds no recording.
        UsageError: A recording is named twice.
    """
    found = find(paths, camera)
    found.require_sound()
    return found.sources


def require_once(found: Sequence[Source]) -> None:
    """Check that no recording is meant twice.

    Raises:
        UsageError: One is.
    """
    if len({source.path.resolve() for source in found}) < len(found):
        raise UsageError("a recording is named twice.")


def kind_of(file: Path) -> Kind:
    """What a file is, by its first bytes.

    Raises:
        RecordingImportError: It cannot be imported.
    """
    from dmotion_bench.storage.video.file import container_of

    try:
        with file.open("rb") as opened:
            start = opened.read(16)
    except OSError as error:
        raise RecordingImportError(f"cannot read {str(file)!r}: {error.strerror}.") from error
    if start.startswith((b"\x89MCAP", b"\x28\xb5\x2f\xfd")):
        return Kind.MCAP
    if start.startswith(b"\x89HDF\r\n\x1a\n"):
        return Kind.HDF5
    if container_of(start) is not None:
        return Kind.VIDEO
    raise RecordingImportError(f"{str(file)!r} {_what_else(start)}.")


def open_recording(source: Source, options: ImportOptions, confinement: Confinement) -> Recording:
    """The recording, read in a process apart where a library of C reads it.

    Raises:
        RecordingImportError: It cannot be imported.
    """
    if source.kind is Kind.PICTURES:
        return open_here(source.path, source.kind, options)
    if source.kind is Kind.MCAP:
        recording = McapRecording(source.path, **_of_mcap(options))
        if recording.is_stream:
            return confinement.open(source.path, Kind.MCAP_VIDEO)
        if options.action_fields:  # its messages are decoded by the definitions in the file, programs of a kind
            return confinement.open(source.path, Kind.MCAP)
        return recording
    return confinement.open(source.path, source.kind)


def open_here(path: Path, kind: str, options: ImportOptions) -> Recording:
    """The recording, read by this process.

    Raises:
        RecordingImportError: It cannot be imported.
    """
    limits = options.limits
    if options.actions is not None and kind in (Kind.PICTURES, Kind.VIDEO):
        raise RecordingImportError(f"{str(path)!r} holds pictures alone, no actions; leave out '--actions'.")
    if kind == Kind.MCAP_VIDEO:
        from dmotion_bench.storage.imports.mcap_video import McapVideo

        return McapVideo(path, **_of_mcap(options))
    if kind == Kind.MCAP:
        return McapRecording(path, **_of_mcap(options))
    if kind == Kind.PICTURES:
        return PictureFolder(
            path,
            camera=options.camera,
            source_hz=options.source_hz or options.hz,
            limits=limits,
            salvage=options.salvage,
        )
    if kind == Kind.VIDEO:
        from dmotion_bench.storage.imports.video_recording import VideoRecording

        return VideoRecording(
            path, camera=options.camera, source_hz=options.source_hz, limits=limits, salvage=options.salvage
        )
    if kind == Kind.HDF5:
        from dmotion_bench.storage.imports.hdf5_recording import Hdf5Recording

        return Hdf5Recording(
            path,
            camera=options.camera,
            actions=options.actions,
            action_fields=options.action_fields,
            source_hz=options.source_hz,
            default_hz=options.hz,
            limits=limits,
        )
    from dmotion_bench.storage.imports.lerobot_recording import LeRobotRecording

    return LeRobotRecording(
        path, camera=options.camera, actions=options.actions, action_fields=options.action_fields, limits=limits
    )


class _McapArguments(TypedDict):
    camera: str | None
    actions: str | None
    action_fields: Sequence[str]
    clock: Clock
    limits: ImportLimits
    salvage: bool


def _of_mcap(options: ImportOptions) -> _McapArguments:
    return {
        "camera": options.camera,
        "actions": options.actions,
        "action_fields": options.action_fields,
        "clock": options.clock,
        "limits": options.limits,
        "salvage": options.salvage,
    }


def _is_told_of(path: Path, faults: Mapping[Path, RecordingImportError]) -> bool:
    return path not in faults and path.is_dir() and not (path / INFO).is_file()


def _taken(sources: Sequence[Source], camera: str | None) -> Taken:
    """What the recordings consist of."""
    folders = [
        one for source in sources if source.kind is Kind.PICTURES for one in episode_folders(source.path, camera)
    ]
    return Taken(
        whole=real_paths(source.path for source in sources if source.kind is not Kind.PICTURES),
        pictures=real_paths(folders),
        chosen=real_paths(one.parent for one in folders if one.name == camera),
    )


def _doubt(over: PassedOver) -> str:
    """What is said of pictures that are too few, beside others that were passed over."""
    named = command("dmbench data import", over.readable[0])
    return (
        f"the pictures that were found in {str(over.folder)!r} are too few for an episode, and other recordings or "
        f"pictures in it were not looked at: {over.listed(over.readable)}. If the recordings are there, name all of "
        f"them, such as {named} and so on; the shell's '*/' names all folders. If the few pictures are the recording, "
        "lower '--min-frames' or name their folder alone."
    )


def _at(path: Path, camera: str | None, faults: dict[Path, RecordingImportError]) -> list[Source]:
    """The recordings at a path; see ``_in_folder``."""
    if not path.exists():
        raise RecordingImportError(f"there is no {str(path)!r}.")
    return _in_folder(path, camera, faults) if path.is_dir() else [Source(path=path, kind=kind_of(path))]


def _in_folder(folder: Path, camera: str | None, faults: dict[Path, RecordingImportError]) -> list[Source]:
    """The recordings in a folder, and in the folders in it.

    Args:
        folder: It.
        camera: See ``find``.
        faults: Is told which folders in it cannot be read.
    """
    if is_dataset(folder):
        raise RecordingImportError(
            f"{str(folder)!r} is a data set of dmbench already; train on it with "
            f"{command('dmbench train MODEL --data', folder)}."
        )
    if (folder / INFO).is_file():
        return [Source(path=folder, kind=Kind.LEROBOT)]
    entries = in_natural_order(one for one in folder.iterdir() if not one.name.startswith("."))
    found = [Source(path=one, kind=kind) for one in entries if one.is_file() and (kind := _suffix_kind(one))]
    for inner in [] if found else [one for one in entries if one.is_dir()]:
        try:
            if (inner / INFO).is_file():
                found.append(Source(path=inner, kind=Kind.LEROBOT))
            elif not is_dataset(inner):
                files = in_natural_order(one for one in inner.iterdir() if one.is_file())
                found += [Source(path=one, kind=kind) for one in files if (kind := _suffix_kind(one))]
        except OSError as error:
            faults[inner] = _unreadable(inner, error)
    if not found and episode_folders(folder, camera):
        return [Source(path=folder, kind=Kind.PICTURES)]
    if not found and not any(folder in one.parents for one in faults):
        raise _nothing_in(folder)
    kinds = {source.kind for source in found}
    if len(kinds) > 1:
        raise RecordingImportError(
            f"{str(folder)!r} holds recordings of several kinds ({', '.join(sorted(kinds))}); name the ones you mean."
        )
    return found


def _suffix_kind(file: Path) -> Kind | None:
    name = file.name.lower()
    return next((kind for suffix, kind in SUFFIXES.items() if name.endswith(suffix)), None)


def _unreadable(folder: Path, error: OSError) -> RecordingImportError:
    kind = "the folder " if folder.is_dir() else ""
    return RecordingImportError(f"cannot read {kind}{str(folder)!r}: {error.strerror}.")


def _nothing_in(folder: Path) -> RecordingImportError:
    if any(folder.glob("*.db3*")):
        return RecordingImportError(f"{str(folder)!r} is a ROS 2 bag in SQLite; {_CONVERT}.")
    return RecordingImportError(
        f"{str(folder)!r} holds no recording: no {KNOWN}, no pictures ({' '.join(PICTURES)}), and it is no LeRobot "
        "data set."
    )


def _what_else(start: bytes) -> str:
    if start.startswith(b"#ROSBAG"):
        return f"is a ROS 1 bag; {_CONVERT}"
    if start.startswith(b"SQLite"):
        return f"is a ROS 2 bag in SQLite; {_CONVERT}"
    if start.startswith((b"\xff\xd8\xff", b"\x89PNG")) or start[8:12] == b"WEBP":
        return "is a single picture; name the folder that it is in"
    if not start:
        return "is empty"
    return f"is no recording that can be imported: {KNOWN}; FFmpeg makes an MKV of other videos: 'ffmpeg -i IN OUT.mkv'"
