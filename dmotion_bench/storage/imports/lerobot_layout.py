"""Where a LeRobot data set keeps what: the formats v2.0, v2.1 and v3.

Layout (github.com/huggingface/lerobot, ``lerobot/datasets/utils.py``): ``meta/info.json`` names the features and the
frame rate. Where an episode stands is said by ``meta/episodes/*/*.parquet`` (v3: many episodes in a file) or
``meta/episodes.jsonl`` (v2: each in files of its own). ``data/`` holds the numbers of each frame, ``videos/`` the
pictures; features of the kind ``image`` have theirs in ``data/`` as PNG files, or in ``images/``. The templates for
paths that ``info.json`` carries are not used: no path from a file is trusted.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from dmotion_bench.actions import Continuous, actions_from_json
from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.git_lfs import require_content
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.near_names import did_you_mean
from dmotion_bench.wording import shown

INFO: Final = Path("meta") / "info.json"
EPISODES_V2: Final = Path("meta") / "episodes.jsonl"
EPISODES_V3: Final = "meta/episodes/*/*.parquet"
ACTION_NAMES: Final = "dmbench_actions"
"""Where ``data export`` leaves the actions' names within the feature, beside LeRobot's own keys."""
SOURCE: Final = "dmbench_source"
"""The column of the table of episodes in which ``data export`` leaves which recording each episode is a part of."""
LISTED: Final = 30  # features that an error names
ROWS_AT_ONCE: Final = 4096
"""Of a table of episodes that are taken apart."""
_KEY: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*")
_CAMERA_KINDS: Final = ("video", "image")


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Where an episode stands.

    Attributes:
        data: The file of its numbers.
        video: The file of its pictures, None where they are no video.
        start_s: When it begins in that file [s].
        source: The number of the recording that it is a part of, where ``data export`` has left one.
    """

    number: int
    frames: int
    data: Path
    video: Path | None
    start_s: float = 0.0
    source: int | None = None


class LeRobotLayout:
    """A data set's description.

    Args:
        path: The folder.
        limits: What its files may make us do.

    Attributes:
        features: By their names.
        fps: Frames a second.

    Raises:
        RecordingImportError: It is damaged, or of a version that is not known.
    """

    def __init__(self, path: Path, limits: ImportLimits) -> None:
        self.path, self._limits = path, limits
        info = self._read_info()
        features = info.get("features")
        if not isinstance(features, dict):
            raise self.bad("has no features in its info.json")
        self.features: Mapping[str, Any] = features
        fps = info.get("fps")
        if not isinstance(fps, int | float) or not 0.001 <= fps <= 10_000:
            raise self.bad(f"says that it has {str(fps)[:40]!r} frames a second")
        self.fps = float(fps)
        size = info.get("chunks_size", 1000)
        self._chunk_episodes = size if isinstance(size, int) and size > 0 else 1000

    def camera(self, asked: str | None) -> str:
        """The camera that is meant: by its name, or by the last part of it.

        Raises:
            RecordingImportError: There is none, or more than one, or it holds depth.
        """
        pictures = sorted(key for key in self.features if self.kind(key) in _CAMERA_KINDS and _KEY.fullmatch(key))
        cameras = [key for key in pictures if not self._is_depth(key)]
        here = [key for key in cameras if self._has_files(key)] or cameras
        found = here if asked is None else _meant(here, asked) or _meant(cameras, asked)
        if len(found) == 1:
            return found[0]
        if asked is None and not cameras:
            others = ", ".join(f"{shown(key)} ({shown(self.kind(key))})" for key in list(self.features)[:LISTED])
            raise self.bad(
                "has no camera: a feature of the kind 'video' or 'image' that holds no depth, with a name of letters, "
                f"digits, '.', '_' and '-'; its features are: {others or 'none'}"
            )
        listed = ", ".join(map(repr, here)) or "none"
        if asked is None:
            raise self.bad(f"has {len(here)} cameras; choose one with '--camera KEY': {listed}")
        if not found and (depth := _meant(pictures, asked)):
            raise self.bad(f"holds depth in {depth[0]!r}, and depth is no picture; its cameras are: {listed}")
        hint = "" if found else did_you_mean(here, asked)
        which = f"{'more than one' if found else 'no'} camera {asked!r}"
        raise self.bad(f"has {which}; {hint}{'Its' if hint else 'its'} cameras are: {listed}")

    def numbers(self, asked: str) -> str:
        """The feature of the actions that is meant: by its name, or by the last part of it.

        Raises:
            RecordingImportError: There is none, or more than one.
        """
        others = sorted(key for key in self.features if self.kind(key) not in _CAMERA_KINDS)
        found = _meant(others, asked)
        if len(found) == 1:
            return found[0]
        how, hint = ("more than one feature", "") if found else ("no feature", did_you_mean(others, asked))
        listed = f"{'Its' if hint else 'its'} features are: {', '.join(others)}"
        raise self.bad(f"has {how} {asked!r} for '--actions'; {hint}{listed}")

    def kind(self, key: str) -> str:
        """A feature's kind: ``"video"``, ``"image"``, ``"float32"`` ..."""
        feature = self.features.get(key)
        return str(feature.get("dtype", "")) if isinstance(feature, Mapping) else ""

    def _is_depth(self, key: str) -> bool:
        """Whether a camera is one of distances; the format keeps this beside the facts of the video."""
        feature = self.features[key]
        places = [feature, *(feature.get(name) for name in ("info", "video_info"))]
        return any(
            place.get(name) is True
            for place in places
            if isinstance(place, Mapping)
            for name in ("is_depth_map", "video.is_depth_map")
        )

    def _has_files(self, camera: str) -> bool:
        """Whether a camera's pictures were downloaded; those in tables come with the numbers."""
        return self.kind(camera) != "video" or next(self._shown(self._videos(camera)), None) is not None

    def _shown(self, pattern: str) -> Iterator[Path]:
        """The files of a pattern that are not hidden; macOS leaves a file ``._NAME`` beside each that it copies."""
        found = self.path.glob(pattern)
        return (file for file in found if not any(part.startswith(".") for part in file.relative_to(self.path).parts))

    def _videos(self, camera: str) -> str:
        return f"videos/*/{camera}/*.mp4" if self.is_v2 else f"videos/{camera}/*/*.mp4"

    def action_names(self, key: str) -> list[Any]:
        """What the file says the actions are called, in the order of their numbers; nothing where it does not."""
        feature = self.features.get(key)
        known = feature.get(ACTION_NAMES) if isinstance(feature, Mapping) else None
        return known if isinstance(known, list) else []

    def number_names(self, key: str) -> tuple[str, ...]:
        """What the file calls the numbers of a feature, in their order; nothing where it does not.

        Names that stand there more than once are told apart: by the group that they are in, else by numbers.
        """
        feature = self.features.get(key)
        names = feature.get("names") if isinstance(feature, Mapping) else None
        if isinstance(names, Mapping) and all(type(place) is int for place in names.values()):
            names = [name for name, _ in sorted(names.items(), key=lambda item: item[1])]
        # groups of names, such as those of a left and a right arm, or a list in a list
        groups = names if isinstance(names, Mapping) else {"": names}
        flat = [(group, name) for group, inside in groups.items() for name in _flat(inside)]
        if not all(isinstance(name, str) for _, name in flat):
            return ()
        if len(groups) > 1 and len({name for _, name in flat}) < len(flat):
            return _numbered([f"{group}.{name}" for group, name in flat])
        return _numbered([name for _, name in flat])

    def stated_actions(self, key: str) -> Continuous | None:
        """The bounds and units of continuous actions, where ``data export`` has left them.

        Raises:
            RecordingImportError: What is left there is nothing of the kind.
        """
        feature = self.features.get(key)
        left = feature.get(ACTION_NAMES) if isinstance(feature, Mapping) else None
        if left is None:
            return None
        try:
            stated = actions_from_json(left)
        except ValueError as error:
            raise self.bad(f"has {ACTION_NAMES} of the feature {key!r} that cannot be: {error}") from error
        return stated if isinstance(stated, Continuous) else None

    def episodes(self, camera: str) -> list[Placed]:
        """Where each episode with frames stands.

        Raises:
            RecordingImportError: The table is damaged.
        """
        with_video = self.kind(camera) == "video"
        found = self._episodes_v2(camera, with_video) if self.is_v2 else self._episodes_v3(camera, with_video)
        placed: list[Placed] = []
        frames, numbers = 0, set[int]()
        for one in found:
            if one.number in numbers:
                raise self.bad(f"describes the episode {one.number} more than once")
            numbers.add(one.number)
            frames += one.frames
            if frames > self._limits.frames:
                raise self.bad("declares more frames than can be imported at once")
            if one.frames:
                placed.append(one)
        if not placed:
            raise self.bad("has no episodes")
        return placed

    def files(self, camera: str) -> list[Path]:
        """The files that are read, in the order of their names.

        Raises:
            RecordingImportError: One of them is a folder, or a pipe.
        """
        pictures = self._videos(camera) if self.kind(camera) == "video" else f"images/{camera}/*/*"
        episodes = EPISODES_V2.as_posix() if self.is_v2 else EPISODES_V3
        found = [self._shown(pattern) for pattern in (episodes, "data/*/*.parquet", pictures)]
        files = sorted([self.path / INFO, *itertools.chain(*found)])
        for file in files:
            if not file.is_file():
                raise self.bad(f"has {file.relative_to(self.path).as_posix()!r}, which is no ordinary file")
        return files

    def picture_file(self, camera: str, episode: int, frame: int) -> Path:
        """A picture that lies beside the tables.

        Raises:
            RecordingImportError: It is not there.
        """
        names = [f"images/{camera}/episode{dash}{episode:06d}/frame{dash}{frame:06d}.png" for dash in "-_"]
        found = next((name for name in names if (self.path / name).is_file()), names[0])
        return self._there(self.path / found)

    def require_files(self, placed: Placed) -> None:
        """Check that an episode's files are there.

        Raises:
            RecordingImportError: One is not.
        """
        self._there(placed.data)
        if placed.video is not None:
            self._there(placed.video)

    def table(self, file: Path, columns: Sequence[str], also: Sequence[str] = ()) -> Any:
        """Some columns of a table, without what LeRobot keeps beside them (statistics of every feature).

        Args:
            file: The table.
            columns: That must be there.
            also: That are read if they are there.

        Raises:
            RecordingImportError: It is damaged or lacks them.
        """
        import pyarrow.parquet as parquet
        from pyarrow import ArrowException

        try:
            with parquet.ParquetFile(file) as table:
                missing = [name for name in columns if name not in table.schema_arrow.names]
                if missing:
                    raise self.bad(f"lacks the columns {', '.join(missing)} in {file.name!r}")
                if table.metadata.num_rows > self._limits.frames:
                    raise self.bad(f"has {table.metadata.num_rows} rows in {file.name!r}, more than can be imported")
                return table.read(columns=[*columns, *(name for name in also if name in table.schema_arrow.names)])
        except (ArrowException, OSError) as error:
            raise self.bad(f"has a damaged table {file.name!r}: {str(error)[:120]}") from error

    def bad(self, reason: str) -> RecordingImportError:
        """The error for this data set."""
        return RecordingImportError(f"the LeRobot data set {str(self.path)!r} {reason}.")

    def _episodes_v3(self, camera: str, with_video: bool) -> Iterator[Placed]:
        video = f"videos/{camera}"
        columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
        if with_video:
            columns += [f"{video}/chunk_index", f"{video}/file_index", f"{video}/from_timestamp"]
        tables = sorted(self._shown(EPISODES_V3))
        if not tables:
            raise self.bad("lacks 'meta/episodes/chunk-000/file-000.parquet', the table of its episodes")
        for file in tables:
            require_content(file)
            table = self.table(file, columns, also=(SOURCE,))
            left = [SOURCE] if SOURCE in table.column_names else []
            for number, frames, *place in _rows(table, [*columns, *left]):
                source = place.pop() if left else None
                start_s = place.pop() if with_video else 0.0
                if not isinstance(start_s, int | float) or not math.isfinite(start_s) or not 0 <= start_s < 2**31:
                    raise self.bad(f"says that an episode starts at {str(start_s)[:40]!r} s of its video")
                if not all(isinstance(value, int) and 0 <= value < 2**31 for value in (number, frames, *place)):
                    raise self.bad(f"has an episode without a place: {str((number, frames, *place))[:120]}")
                if source is not None and not (isinstance(source, int) and 0 <= source < 2**31):
                    raise self.bad(f"says that an episode is a part of the recording {str(source)[:40]!r}")
                yield Placed(
                    number=number,
                    frames=frames,
                    data=self.path / "data/chunk-{:03d}/file-{:03d}.parquet".format(*place),
                    video=self.path / f"{video}/chunk-{place[2]:03d}/file-{place[3]:03d}.mp4" if with_video else None,
                    start_s=float(start_s),
                    source=source,
                )

    def _episodes_v2(self, camera: str, with_video: bool) -> Iterator[Placed]:
        require_content(self.path / EPISODES_V2)
        for line in self._lines(self.path / EPISODES_V2):
            try:
                row = json.loads(line)
                number, frames = row["episode_index"], row["length"]
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise self.bad(f"has a damaged {EPISODES_V2.name!r}: {str(error)[:120]}") from error
            if not all(isinstance(value, int) and 0 <= value < 2**31 for value in (number, frames)):
                raise self.bad(f"has an episode without a place: {str((number, frames))[:120]}")
            chunk, name = f"chunk-{number // self._chunk_episodes:03d}", f"episode_{number:06d}"
            yield Placed(
                number=number,
                frames=frames,
                data=self.path / f"data/{chunk}/{name}.parquet",
                video=self.path / f"videos/{chunk}/{camera}/{name}.mp4" if with_video else None,
            )

    def _lines(self, file: Path) -> Iterator[bytes]:
        try:
            with file.open("rb") as opened:
                while line := opened.readline(16 * MIB):
                    if line.strip():
                        yield line
        except OSError as error:
            raise self.bad(f"has no {EPISODES_V2.name!r} that can be read: {error.strerror}") from error

    def _read_info(self) -> Mapping[str, Any]:
        require_content(self.path / INFO)
        try:
            with (self.path / INFO).open("rb") as file:
                raw = file.read(16 * MIB)
            info = json.loads(raw)
        except (OSError, ValueError, RecursionError) as error:
            raise self.bad(f"has a damaged info.json: {str(error)[:120]}") from error
        version = str(info.get("codebase_version")) if isinstance(info, dict) else "None"
        if not version.startswith(("v2", "v3")):
            raise self.bad(
                f"is of LeRobot's format {version[:20]!r}; v2 and v3 can be read. Convert it with the scripts in "
                "'lerobot.datasets' of its time"
            )
        self.is_v2 = version.startswith("v2")
        found: Mapping[str, Any] = info
        return found

    def _there(self, file: Path) -> Path:
        if not file.is_file():
            raise self.bad(f"lacks the file {file.relative_to(self.path).as_posix()!r}")
        require_content(file)
        return file


def _meant(keys: Sequence[str], asked: str) -> list[str]:
    """The feature of this name, else those whose last part it is."""
    return [asked] if asked in keys else [key for key in keys if key.endswith(f".{asked}")]


def _flat(names: Any) -> list[Any]:
    """A list of names, perhaps in lists of their own; of anything else nothing."""
    inside = names if isinstance(names, list) else []
    return [name for one in inside for name in (one if isinstance(one, list) else [one])]


def _numbered(names: Sequence[str]) -> tuple[str, ...]:
    """Names, of which those that stand there more than once get a number: ``arm.0``, ``arm.1``; none if that fails."""
    counts, seen = Counter(names), Counter[str]()
    found = []
    for name in names:
        found.append(f"{name}.{seen[name]}" if counts[name] > 1 else name)
        seen[name] += 1
    return tuple(found) if len(set(found)) == len(found) else ()


def _rows(table: Any, columns: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """The rows of a table; only so many at a time become Python's values, so that a fault ends it early."""
    for batch in table.to_batches(max_chunksize=ROWS_AT_ONCE):
        yield from zip(*(batch.column(name).to_pylist() for name in columns), strict=True)
