"""A LeRobot data set (format v3) as a recording: one segment an episode.

Layout (github.com/huggingface/lerobot, ``lerobot/datasets/utils.py``): ``meta/info.json`` names the features and
the frame rate, ``meta/episodes/*/*.parquet`` says where each episode stands, ``data/*/*.parquet`` holds the
numbers of each frame, ``videos/KEY/*/*.mp4`` the pictures of many episodes, one after the other. The templates
for paths that ``info.json`` carries are not used: no path from a file is trusted.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture
from dmotion_bench.storage.imports.commands import Commands, action_name
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.recording import Segment, Survey
from dmotion_bench.storage.video import VideoReader

INFO: Final = Path("meta") / "info.json"
ACTION_NAMES: Final = "dmbench_actions"
"""Where ``data export`` leaves the actions' names within the feature, beside LeRobot's own keys."""
_KEY: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*")


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (path / INFO).is_file()


@dataclass(frozen=True, kw_only=True)
class _Placed:
    """Where an episode stands.

    Attributes:
        video: The file of its pictures.
        first: The number of its first picture in that file.
        data: The file of its numbers.
    """

    number: int
    frames: int
    video: Path
    first: int
    data: Path


class LeRobotRecording:
    """One data set's folder.

    Args:
        path: The folder.
        camera: The feature of the pictures, ``"observation.images.front"``; None for the only one.
        actions: The feature of the actions; None for none.
        limits: What the files may make us do.

    Raises:
        RecordingImportError: Not a data set of format v3, or it lacks the features.
    """

    def __init__(self, path: Path, *, camera: str | None, actions: str | None, limits: ImportLimits) -> None:
        self.path, self._actions, self._limits, self.unreadable = path, actions, limits, 0
        self._info = self._read_info()
        features = self._features = self._mapping(self._info, "features")
        self._camera = self._camera_of(camera)
        if actions is not None and actions not in features:
            raise self._bad(f"has no feature {actions!r}; its features are: {', '.join(sorted(features))}")
        fps = self._info.get("fps")
        if not isinstance(fps, int | float) or not 0.001 <= fps <= 10_000:
            raise self._bad(f"says that it has {str(fps)[:40]!r} frames a second")
        self._fps = float(fps)
        self._vocabulary = self._known_actions()
        self._placed: list[_Placed] = []
        self._numbers: tuple[Path, Any] | None = None  # the table of numbers that was read last

    def sha256(self) -> str:
        """Over the hashes of the files that are read, in the order of their names."""
        digest = hashlib.sha256()
        videos = self.path / "videos" / self._camera
        for file in sorted([self.path / INFO, *self.path.glob("data/*/*.parquet"), *videos.glob("*/*.mp4")]):
            with file.open("rb") as opened:
                digest.update(hashlib.file_digest(opened, "sha256").digest())
        return digest.hexdigest()

    def survey(self) -> Survey:
        """Read the tables; of the videos only the heads.

        Raises:
            RecordingImportError: As the files deserve it.
        """
        self._placed = self._episodes()
        if not self._placed:
            raise self._bad("has no episodes")
        sizes = set()
        for file in sorted({placed.video for placed in self._placed}):
            with VideoReader(file, pixels=self._limits.pixels) as video:
                sizes.add((video.height, video.width))
        if len(sizes) != 1:
            raise self._bad(f"mixes picture sizes: {sorted(sizes)}")
        height, width = sizes.pop()
        segments = []
        for placed in self._placed:
            times = np.rint(np.arange(placed.frames) * (1e9 / self._fps)).astype(np.int64)
            segments.append(Segment(times_ns=times, commands=self._commands(placed, times)))
        return Survey(camera=self._camera, height=height, width=width, segments=segments)

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Decode the episode's stretch of its video."""
        placed = self._placed[segment]
        with VideoReader(placed.video, pixels=self._limits.pixels) as video:
            yield from video.frames((wanted + placed.first).tolist(), self._fps)

    def _episodes(self) -> list[_Placed]:
        video = f"videos/{self._camera}"
        columns = ["episode_index", "length", f"{video}/chunk_index", f"{video}/file_index", f"{video}/from_timestamp"]
        columns += ["data/chunk_index", "data/file_index"]
        placed: list[_Placed] = []
        for file in sorted(self.path.glob("meta/episodes/*/*.parquet")):
            for row in self._rows(file, columns):
                number, frames, video_chunk, video_file, start_s, data_chunk, data_file = row
                if not isinstance(start_s, int | float) or not math.isfinite(start_s) or start_s < 0:
                    raise self._bad(f"says that an episode starts at {str(start_s)[:40]!r} s of its video")
                whole = (number, frames, video_chunk, video_file, data_chunk, data_file)
                if not all(isinstance(value, int) and 0 <= value < 2**31 for value in whole):
                    raise self._bad(f"has an episode without a place: {whole}")
                placed.append(
                    _Placed(
                        number=number,
                        frames=frames,
                        video=self._inside(f"{video}/chunk-{video_chunk:03d}/file-{video_file:03d}.mp4"),
                        first=round(start_s * self._fps),
                        data=self._inside(f"data/chunk-{data_chunk:03d}/file-{data_file:03d}.parquet"),
                    )
                )
        if sum(one.frames for one in placed) > self._limits.frames:
            raise self._bad("declares more frames than can be imported at once")
        return [one for one in placed if one.frames]

    def _rows(self, file: Path, columns: Sequence[str]) -> list[tuple[Any, ...]]:
        """A table's rows."""
        table = self._table(file, columns)
        return list(zip(*(table.column(name).to_pylist() for name in columns), strict=True))

    def _table(self, file: Path, columns: Sequence[str]) -> Any:
        """Some columns of a table, without what LeRobot keeps beside (statistics of every feature)."""
        import pyarrow.parquet as parquet
        from pyarrow import ArrowException

        try:
            with parquet.ParquetFile(file) as table:
                missing = [name for name in columns if name not in table.schema_arrow.names]
                if missing:
                    raise self._bad(f"lacks the columns {', '.join(missing)} in {file.name!r}")
                if table.metadata.num_rows > self._limits.frames:
                    raise self._bad(f"has {table.metadata.num_rows} rows in {file.name!r}, more than can be imported")
                return table.read(columns=list(columns))
        except (ArrowException, OSError) as error:
            raise self._bad(f"has a damaged table {file.name!r}: {str(error)[:120]}") from error

    def _commands(self, placed: _Placed, times_ns: Int64[np.ndarray, " n"]) -> Commands | None:
        if self._actions is None:
            return None
        if self._numbers is None or self._numbers[0] != placed.data:  # episodes stand side by side in few files
            self._numbers = placed.data, self._table(placed.data, ["episode_index", "frame_index", self._actions])
        table = self._numbers[1]
        inside = np.flatnonzero(table.column("episode_index").to_numpy() == placed.number)
        frames = table.column("frame_index").to_numpy()[inside]
        if not np.array_equal(frames, np.arange(placed.frames)):
            raise self._bad(f"lacks actions of episode {placed.number}, or has them out of order")
        names = []
        for value in table.column(self._actions).take(inside).to_pylist():
            single = value[0] if isinstance(value, list) and len(value) == 1 else value
            try:
                name = action_name(single)
                number = int(name) if name.isdecimal() else -1
                names.append(self._vocabulary[number] if 0 <= number < len(self._vocabulary) else name)
            except BadPicture as error:
                raise self._bad(f"{error} (feature {self._actions!r}, episode {placed.number})") from error
        return Commands(times_ns=times_ns, names=names, vocabulary=self._vocabulary)

    def _known_actions(self) -> list[str]:
        """The names of the actions in the order of their numbers, where ``data export`` has left them."""
        feature = self._features.get(self._actions or "")
        known = feature.get(ACTION_NAMES) if isinstance(feature, Mapping) else None
        try:
            return [action_name(name) for name in known] if isinstance(known, list) else []
        except BadPicture as error:
            raise self._bad(f"{error} ({ACTION_NAMES} of the feature {self._actions!r})") from error

    def _camera_of(self, asked: str | None) -> str:
        """The feature that is meant: by its name, or by the last part of it."""
        videos = [key for key, feature in self._features.items() if _kind(feature) == "video"]
        cameras = sorted(key for key in videos if _KEY.fullmatch(key))
        found = cameras if asked is None else [key for key in cameras if key == asked or key.endswith(f".{asked}")]
        if asked in found:
            return asked
        if len(found) == 1:
            return found[0]
        listed = ", ".join(map(repr, cameras)) or "none"
        if asked is None:
            raise self._bad(f"has {len(cameras)} cameras; choose one with '--camera KEY': {listed}")
        raise self._bad(f"has {'no' if not found else 'more than one'} camera {asked!r}; its cameras are: {listed}")

    def _read_info(self) -> Mapping[str, Any]:
        try:
            with (self.path / INFO).open("rb") as file:
                raw = file.read(16 * MIB)
            info = json.loads(raw)
        except (OSError, ValueError, RecursionError) as error:
            raise self._bad(f"has a damaged info.json: {str(error)[:120]}") from error
        version = info.get("codebase_version") if isinstance(info, dict) else None
        if not isinstance(info, dict) or not str(version).startswith("v3"):
            raise self._bad(
                f"is of LeRobot's format {str(version)[:20]!r}; only v3 can be read. Convert it with "
                "'python -m lerobot.datasets.v30.convert_dataset_v21_to_v30'"
            )
        return info

    def _mapping(self, info: Mapping[str, Any], key: str) -> Mapping[str, Any]:
        found = info.get(key)
        if not isinstance(found, dict):
            raise self._bad(f"has no {key} in its info.json")
        return found

    def _inside(self, relative: str) -> Path:
        file = self.path / relative
        if not file.is_file():
            raise self._bad(f"lacks the file {relative!r}")
        return file

    def _bad(self, reason: str) -> RecordingImportError:
        return RecordingImportError(f"the LeRobot data set {str(self.path)!r} {reason}.")


def _kind(feature: Any) -> str:
    return str(feature.get("dtype", "")) if isinstance(feature, Mapping) else ""
