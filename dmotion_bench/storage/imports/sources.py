"""The kinds of recordings: how each is told from the others, and who reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, TypedDict

from dmotion_bench.errors import InvalidSetting, RecordingImportError
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.git_lfs import IS_POINTER, is_pointer, require_content
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.mcap_recording import McapRecording
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.passed_over import CONVERTER, NOT_READ, arrays_of
from dmotion_bench.storage.imports.picture_folder import PictureFolder, pattern_of
from dmotion_bench.storage.imports.recording import Clock, Recording


class Kind(StrEnum):
    """A container of recordings, one class each."""

    MCAP = "mcap"
    MCAP_VIDEO = "mcap_video"
    VIDEO = "video"
    HDF5 = "hdf5"
    PICTURES = "pictures"
    LEROBOT = "lerobot"


WITHOUT_ACTIONS: Final = (Kind.PICTURES, Kind.VIDEO)
"""Containers that hold nothing but pictures."""

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
CONVERT_BAG: Final = f"convert it with {CONVERTER}"
UNSALVAGED: Final = (Kind.HDF5, Kind.LEROBOT)
"""Kinds for which ``--salvage`` does nothing."""
_WITHOUT_TIMES: Final = (Kind.VIDEO, Kind.HDF5, Kind.PICTURES)
"""Kinds for which ``--source-hz`` says when the pictures were taken."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A recording that is not opened yet."""

    path: Path
    kind: Kind


def kind_of(file: Path) -> Kind:
    """What a file is, by its first bytes.

    Raises:
        RecordingImportError: It cannot be imported.
    """
    from dmotion_bench.storage.video.file import container_of

    if not file.is_file():  # it would be waited for, and can be read once
        raise RecordingImportError(
            f"{str(file)!r} is no ordinary file; save what comes out of it, and import that file."
        )
    try:
        with file.open("rb") as opened:
            start = opened.read(64)
    except OSError as error:
        raise RecordingImportError(f"cannot read {str(file)!r}: {error.strerror}.") from error
    if start.startswith((b"\x89MCAP", b"\x28\xb5\x2f\xfd")):
        return Kind.MCAP
    if start.startswith(b"\x89HDF\r\n\x1a\n"):
        return Kind.HDF5
    if container_of(start[:16]) is not None:
        return Kind.VIDEO
    raise RecordingImportError(f"{str(file)!r} {_what_else(start, file)}.")


def require_effect(sources: Sequence[Source], options: ImportOptions) -> None:
    """Check that options about times change something for one of the recordings at least.

    Raises:
        InvalidSetting: One does not.
    """
    kinds = {source.kind for source in sources}
    if kinds and options.source_hz is not None and kinds.isdisjoint(_WITHOUT_TIMES):
        raise InvalidSetting(
            "'--source-hz' is for pictures, HDF5 files and videos; MCAP files and LeRobot data sets say when their "
            "pictures were taken: leave it out."
        )
    if kinds and options.clock is Clock.HEADER and Kind.MCAP not in kinds:
        raise InvalidSetting(
            "'--clock header' is for MCAP files; other recordings have one time for each picture at most: leave it out."
        )


def camera_file(video: Path, camera: str | None) -> bool:
    """Whether a video is a camera's by its name or its pattern; a number is that of a stream in it."""
    return camera is not None and camera in (video.stem, pattern_of(video.stem)) and not camera.isdecimal()


def open_recording(source: Source, options: ImportOptions, confinement: Confinement) -> Recording:
    """The recording, read in a process apart where a library of C reads it.

    Raises:
        RecordingImportError: It cannot be imported.
    """
    if source.path.is_file():
        require_content(source.path)
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
    if options.actions is not None and kind in WITHOUT_ACTIONS:
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
            is_rate_assumed=options.source_hz is None,
        )
    if kind == Kind.VIDEO:
        from dmotion_bench.storage.imports.video_recording import VideoRecording

        camera = None if camera_file(path, options.camera) else options.camera
        return VideoRecording(path, camera=camera, source_hz=options.source_hz, limits=limits, salvage=options.salvage)
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
            skip_damaged=options.skip_damaged,
        )
    from dmotion_bench.storage.imports.lerobot_recording import LeRobotRecording

    return LeRobotRecording(
        path,
        camera=options.camera,
        actions=options.actions,
        action_fields=options.action_fields,
        limits=limits,
        skip_damaged=options.skip_damaged,
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


def _what_else(start: bytes, file: Path) -> str:
    if is_pointer(start):
        return IS_POINTER
    if start.startswith(b"#ROSBAG"):
        return f"is a ROS 1 bag; {CONVERT_BAG}"
    if start.startswith(b"SQLite"):
        return f"is a ROS 2 bag in SQLite; {CONVERT_BAG}"
    is_picture = start.startswith((b"\xff\xd8\xff", b"\x89PNG")) or start[8:12] == b"WEBP"
    if is_picture and file.suffix.lower() not in (".mjpeg", ".mjpg"):  # many JPEG files in one
        return "is a single picture; name the folder that it is in"
    if (arrays := arrays_of(file.name)) is not None:
        return f"holds {arrays}, {NOT_READ}"
    return f"is no recording that can be imported: {KNOWN}; FFmpeg makes an MKV of other videos: 'ffmpeg -i IN OUT.mkv'"
