"""A data set -> LeRobot's format v3: numbers in Parquet, pictures of many episodes in one MP4 file.

Layout and names are those of ``lerobot/datasets`` 0.4 (codebase version v3.0). Features written:

- ``observation.images.camera``: the frames. The default codec, H.264 on RGB planes without quantisation, is
  lossless; ``av1`` is LeRobot's own choice, smaller and lossy. Every file is decoded again after it was written
  and the loss is measured, whatever the codec claims.
- ``action``: a discrete action's number (int64), or a continuous action's numbers (float32 where that holds all of
  them exactly, else float64). Their names stand beside them, those of discrete actions and the bounds and units of
  continuous ones in a key of our own. LeRobot wants an action at every frame, so the last frame of an episode, after
  which nothing was done, repeats the one before.
- ``observation.state``: the agent's position [m], where the environment knows it.

Which recording an episode is a part of, where the data set is split by it, stands in a column of our own in the table
of episodes. Masks, objects, control tasks and the seed of the split have no place there and stay behind.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from jaxtyping import UInt8

from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import LabelsNotAvailable, UsageError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot_actions import ACTION, action_column, action_feature, matrix, narrowed
from dmotion_bench.storage.exports.statistics import PixelCounts, Summary, of_numbers
from dmotion_bench.storage.staging import staged
from dmotion_bench.storage.video.codecs import H264, Codec
from dmotion_bench.storage.video.file import VideoFile
from dmotion_bench.storage.video.writer import VideoWriter

CAMERA: Final = "observation.images.camera"
STATE: Final = "observation.state"
SOURCE: Final = "dmbench_source"  # read back by ``imports/lerobot_layout.py``
UNFINISHED: Final = ".exporting"
CHUNK_FILES: Final = 1000
DATA_MIB, VIDEO_MIB = 100, 200
_FASTEST_NS, _SLOWEST_NS = 100_000, 1_000_000_000_000  # between two frames of a video
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """What was written, and what the codec lost.

    Attributes:
        path: The folder.
        labels: Whether actions were written.
        codec: Of the video.
        video_bytes: Of all video files.
        mse: Mean squared error over all pixels and channels, 0-255.
        largest_error: Of any pixel and channel, 0-255.
    """

    path: Path
    episodes: int
    frames: int
    labels: bool
    codec: str
    video_bytes: int
    mse: float
    largest_error: int

    @property
    def psnr(self) -> float:
        """[dB]; infinite without loss."""
        return math.inf if not self.mse else 10 * math.log10(255**2 / self.mse)

    def __fspath__(self) -> str:
        """The folder that was written."""
        return str(self.path)


@dataclass(frozen=True, kw_only=True)
class _Placed:
    """An episode in the files.

    Attributes:
        start: Number of its first frame in the data set.
        file: Number of its video file.
        first: Number of its first frame in that file.
        summaries: Statistics of its features.
    """

    length: int
    start: int
    file: int
    first: int
    summaries: Mapping[str, Summary]


def has_labels(dataset: Dataset) -> bool:
    """Whether the data set's labels are there."""
    try:
        dataset.states(0)
    except LabelsNotAvailable:
        return False
    return True


def export_lerobot(
    dataset: Dataset,
    out: Path,
    *,
    codec: Codec = H264,
    labels: bool = True,
    progress: Progress = lambda what, done, total: None,
) -> ExportReport:
    """Write a data set in LeRobot's format.

    Args:
        dataset: What is exported.
        out: The folder, which must not exist yet.
        codec: Of the video.
        labels: Whether to write actions and the agent's position.
        progress: Is told what is being done, how many episodes are done, and how many there are.

    Raises:
        UsageError: The folder is there already, or the codec cannot take such frames or such a rate.
        LabelsNotAvailable: Labels were asked for and are not there.
    """
    if out.exists():
        raise UsageError(f"{str(out)!r} is there already; name another folder with '--out DIR', or delete it first.")
    if out.resolve().is_relative_to(dataset.path.resolve()):
        raise UsageError(f"{str(out)!r} lies in the data set itself; name a folder elsewhere with '--out DIR'.")
    if codec is not H264 and (dataset.spec.height % 2 or dataset.spec.width % 2):
        size = f"{dataset.spec.width}x{dataset.spec.height}"
        raise UsageError(f"{codec.name} needs even sizes, not {size}; use '--codec h264'.")
    step_ns = dataset.spec.step_ns
    if not _FASTEST_NS <= step_ns <= _SLOWEST_NS:
        raise UsageError(
            f"a video cannot hold a frame every {step_ns / 1e9:g} s; it can be one every {_FASTEST_NS / 1e9:g} s to "
            f"{_SLOWEST_NS / 1e9:g} s."
        )
    with staged(out, UNFINISHED) as folder:
        report = _Export(dataset, folder, codec, labels, progress).run()
    return ExportReport(path=out, labels=labels, codec=codec.name, **report)


class _Export:
    """One export: its files so far."""

    def __init__(self, dataset: Dataset, out: Path, codec: Codec, labels: bool, progress: Progress) -> None:
        self._dataset, self._out, self._codec, self._progress = dataset, out, codec, progress
        self._labels = labels
        self._state = labels and not np.isnan(dataset.states(0).agent.position).all()  # else nothing tells it
        self._fps = Fraction(1_000_000_000, dataset.spec.step_ns).limit_denominator(1001)
        self._pixels = PixelCounts()

    def run(self) -> dict[str, Any]:
        placed, tables = self._write_videos_and_numbers()
        table = narrowed(pa.concat_tables(tables))
        _write_table(self._out / "data/chunk-000/file-000.parquet", table)
        self._write_episodes(placed)
        _write_table(self._out / "meta/tasks.parquet", _tasks_table(self._task()))
        numbers = {name: of_numbers(matrix(table, name)) for name in table.column_names}
        _write_json(self._out / "meta/stats.json", {CAMERA: self._pixels.summary(), **numbers})
        _write_json(self._out / "meta/info.json", self._info(len(placed), table))
        error, largest = self._measure(placed)
        return {
            "episodes": len(placed),
            "frames": table.num_rows,
            "video_bytes": sum(file.stat().st_size for file in self._out.glob("videos/*/*/*.mp4")),
            "mse": error / (table.num_rows * self._dataset.spec.height * self._dataset.spec.width * 3),
            "largest_error": largest,
        }

    def _write_videos_and_numbers(self) -> tuple[list[_Placed], list[pa.Table]]:
        dataset, spec = self._dataset, self._dataset.spec
        placed: list[_Placed] = []
        tables: list[pa.Table] = []
        start = file = 0
        writer: VideoWriter | None = None
        try:
            for episode in range(len(dataset)):
                self._progress("writing", episode, len(dataset))
                if writer is not None and writer.bytes > VIDEO_MIB << 20:
                    writer.close()
                    writer, file = None, file + 1
                if writer is None:
                    writer = VideoWriter(
                        self._video(file), self._codec, fps=self._fps, height=spec.height, width=spec.width
                    )
                frames = dataset.video(episode)
                first = writer.count
                writer.write(frames)
                table = self._numbers(episode, start, len(frames))
                counts = PixelCounts()
                counts.add(frames)
                self._pixels.merge(counts)
                summaries = {name: of_numbers(matrix(table, name)) for name in table.column_names}
                summaries[CAMERA] = counts.summary()
                placed.append(_Placed(length=len(frames), start=start, file=file, first=first, summaries=summaries))
                tables.append(table)
                start += len(frames)
        finally:
            if writer is not None:
                writer.close()
        return placed, tables

    def _numbers(self, episode: int, start: int, length: int) -> pa.Table:
        """The rows of one episode."""
        frame = np.arange(length)
        columns: dict[str, Any] = {}
        if self._labels:
            labels = self._dataset.states(episode)
            columns[ACTION] = action_column(labels.actions, self._actions())
            if self._state:
                position = labels.agent.position.astype(np.float32)  # of each agent, one after the other
                columns[STATE] = pa.FixedSizeListArray.from_arrays(
                    pa.array(position.reshape(-1)), 3 * position.shape[1]
                )
        columns["timestamp"] = pa.array((frame / float(self._fps)).astype(np.float32))
        columns["frame_index"] = pa.array(frame)
        columns["episode_index"] = pa.array(np.full(length, episode))
        columns["index"] = pa.array(start + frame)
        columns["task_index"] = pa.array(np.zeros(length, np.int64))
        return pa.table(columns)

    def _write_episodes(self, placed: list[_Placed]) -> None:
        rate, sources = float(self._fps), self._dataset.rows.sources
        columns: dict[str, list[Any]] = {}
        for number, one in enumerate(placed):
            row: dict[str, Any] = {
                "episode_index": number,
                "tasks": [self._task()],
                "length": one.length,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": one.start,
                "dataset_to_index": one.start + one.length,
                f"videos/{CAMERA}/chunk_index": one.file // CHUNK_FILES,
                f"videos/{CAMERA}/file_index": one.file % CHUNK_FILES,
                f"videos/{CAMERA}/from_timestamp": one.first / rate,
                f"videos/{CAMERA}/to_timestamp": (one.first + one.length) / rate,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            if sources is not None:
                row[SOURCE] = int(sources[number])
            for feature, summary in one.summaries.items():
                row |= {f"stats/{feature}/{name}": values for name, values in summary.items()}
            for name, value in row.items():
                columns.setdefault(name, []).append(value)
        _write_table(self._out / "meta/episodes/chunk-000/file-000.parquet", pa.table(columns))

    def _actions(self) -> ActionSpec:
        spec = self._dataset.spec.actions
        assert spec is not None  # there are labels
        return spec

    def _info(self, episodes: int, table: pa.Table) -> dict[str, Any]:
        spec = self._dataset.spec
        fps: int | float = int(self._fps) if self._fps.denominator == 1 else float(self._fps)
        features: dict[str, Any] = {
            CAMERA: {
                "dtype": "video",
                "shape": [spec.height, spec.width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": spec.height,
                    "video.width": spec.width,
                    "video.codec": self._codec.decoder,
                    "video.pix_fmt": self._codec.stored,
                    "video.is_depth_map": False,
                    "video.fps": fps,
                    "video.channels": 3,
                    "has_audio": False,
                },
            }
        }
        if self._labels:
            features[ACTION] = action_feature(self._actions(), table.schema.field(ACTION).type)
        if self._state:
            names = [f"{axis}{agent or ''}" for agent in range(len(self._dataset.spec.agents)) for axis in "xyz"]
            features[STATE] = {"dtype": "float32", "shape": [len(names)], "names": names}
        for name, kind in (("timestamp", "float32"), *((index, "int64") for index in _INDICES)):
            features[name] = {"dtype": kind, "shape": [1], "names": None}
        return {
            "codebase_version": "v3.0",
            "robot_type": spec.id,
            "total_episodes": episodes,
            "total_frames": table.num_rows,
            "total_tasks": 1,
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": DATA_MIB,
            "video_files_size_in_mb": VIDEO_MIB,
            "fps": fps,
            "splits": {"train": f"0:{episodes}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": features,
        }

    def _measure(self, placed: list[_Placed]) -> tuple[float, int]:
        """Decode every file again: the sum of squared errors, and the largest error."""
        spec = self._dataset.spec
        total, largest = 0.0, 0
        for file in sorted({one.file for one in placed}):
            inside = [number for number, one in enumerate(placed) if one.file == file]
            count = sum(placed[number].length for number in inside)
            with VideoFile(self._video(file), pixels=spec.height * spec.width) as video:
                rate = float(self._fps)
                decoded = video.frames_at([number / rate for number in range(count)], within=0.5 / rate)
                for number in inside:
                    self._progress("measuring the loss", number, len(placed))
                    for frame in self._dataset.video(number):
                        got = next(decoded)
                        difference: UInt8[np.ndarray, "h w 3"] = np.maximum(frame, got) - np.minimum(frame, got)
                        largest = max(largest, int(difference.max()))
                        if largest:
                            total += float(np.square(difference, dtype=np.float64).sum())
        return total, largest

    def _video(self, file: int) -> Path:
        return self._out / f"videos/{CAMERA}/chunk-{file // CHUNK_FILES:03d}/file-{file % CHUNK_FILES:03d}.mp4"

    def _task(self) -> str:
        return f"{self._dataset.recipe.environment}: {self._dataset.recipe.policy}"


_INDICES: Final = ("frame_index", "episode_index", "index", "task_index")


def _tasks_table(task: str) -> pa.Table:
    """What pandas writes for a frame indexed by the task's words, which LeRobot reads with pandas."""
    table = pa.table({"task_index": pa.array([0], pa.int64()), "__index_level_0__": pa.array([task])})
    kinds = (("task_index", "task_index", "int64", "int64"), (None, "__index_level_0__", "unicode", "object"))
    described = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [
            {
                "name": None,
                "field_name": None,
                "pandas_type": "unicode",
                "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"},
            }
        ],
        "columns": [
            {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
            for name, field, kind, numpy_kind in kinds
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _write_table(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path, compression="snappy")


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + "\n")
