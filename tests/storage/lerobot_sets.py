"""LeRobot data sets as others write them, made by hand: v2.1 and v3, with videos or with pictures in the tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from storage.foreign import compressed
from storage.foreign_video import video_file

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions

CAMERA = "observation.images.top"
OPTIONS = ImportOptions(size=32)
LENGTHS = [5, 4, 6]
START = [0, 5, 9]
IMAGE = pa.struct({"bytes": pa.binary(), "path": pa.string()})


def describe(folder: Path, version: str, kind: str, **more: Any) -> None:
    """``meta/info.json``."""
    features = {
        CAMERA: {"dtype": kind, "shape": [32, 32, 3], "names": ["height", "width", "channels"]},
        "action": {"dtype": "int64", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    info = {"codebase_version": version, "fps": 10, "chunks_size": 1000, "features": features, **more}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))


def rows(episodes: list[int], frames: np.ndarray | None, with_bytes: bool = True) -> pa.Table:
    """The numbers of some episodes; with their pictures, if they are given."""
    columns: dict[str, Any] = {
        "episode_index": np.concatenate([np.full(LENGTHS[one], one) for one in episodes]),
        "frame_index": np.concatenate([np.arange(LENGTHS[one]) for one in episodes]),
        "action": np.concatenate([np.arange(LENGTHS[one]) % 2 for one in episodes]),
    }
    if frames is not None:
        wanted = [START[one] + number for one in episodes for number in range(LENGTHS[one])]
        stored = [
            {"bytes": compressed(frames[number], "png") if with_bytes else None, "path": "x.png"} for number in wanted
        ]
        columns[CAMERA] = pa.array(stored, IMAGE)
    return pa.table(columns)


def v21(folder: Path, frames: np.ndarray, kind: str, chunk: int = 1000) -> Path:
    """Each episode in files of its own."""
    describe(folder, "v2.1", kind, chunks_size=chunk)
    lines = [{"episode_index": one, "tasks": ["push"], "length": length} for one, length in enumerate(LENGTHS)]
    (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for one, length in enumerate(LENGTHS):
        data = folder / f"data/chunk-{one // chunk:03d}"
        data.mkdir(parents=True, exist_ok=True)
        parquet.write_table(rows([one], frames if kind == "image" else None), data / f"episode_{one:06d}.parquet")
        if kind == "video":
            films = folder / f"videos/chunk-{one // chunk:03d}/{CAMERA}"
            films.mkdir(parents=True, exist_ok=True)
            video_file(films / f"episode_{one:06d}.mp4", frames[START[one] : START[one] + length])
    return folder


def v3(folder: Path, frames: np.ndarray, with_bytes: bool = True, row_group: int = 4) -> Path:
    """All episodes in one table, their pictures with them."""
    describe(folder, "v3.0", "image")
    for name, table in (
        (
            "meta/episodes",
            pa.table(
                {
                    "episode_index": range(3),
                    "length": LENGTHS,
                    "data/chunk_index": [0] * 3,
                    "data/file_index": [0] * 3,
                }
            ),
        ),
        ("data", rows([0, 1, 2], frames, with_bytes)),
    ):
        (folder / name / "chunk-000").mkdir(parents=True)
        parquet.write_table(table, folder / name / "chunk-000/file-000.parquet", row_group_size=row_group)
    return folder


def same(folder: Path, frames: np.ndarray) -> None:
    report = import_recordings([folder], folder.parent / "out", ImportOptions(size=32, camera="top", actions="action"))
    dataset = Dataset.open(report.path)
    assert dataset.lengths.tolist() == LENGTHS
    for episode, start in enumerate(START):
        np.testing.assert_array_equal(dataset.video(episode), frames[start : start + LENGTHS[episode]])
        assert dataset.states(episode).actions.tolist() == [number % 2 for number in range(LENGTHS[episode] - 1)]
    assert dataset.recipe.parameters["camera"] == CAMERA


def refused(folder: Path, match: str, options: ImportOptions = OPTIONS) -> None:
    with pytest.raises(RecordingImportError, match=match):
        import_recordings([folder], folder.parent / "out", options)
    assert not (folder.parent / "out").exists()
