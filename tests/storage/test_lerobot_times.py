"""The time stamps of LeRobot data sets: which picture belongs to which row, where there are gaps, what cannot be."""

from __future__ import annotations

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from storage.foreign import video
from storage.foreign_video import moving, video_file
from storage.lerobot_sets import CAMERA, LENGTHS, describe, refused, same, v3

from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.lerobot_recording import LeRobotRecording
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions


def with_times(folder: Path, interval: float) -> None:
    """Give the table of ``v3`` time stamps."""
    with_stamps(
        folder / "data/chunk-000/file-000.parquet", [interval * frame for length in LENGTHS for frame in range(length)]
    )


def with_stamps(path: Path, stamps: list[float]) -> None:
    table = parquet.read_table(path)
    parquet.write_table(table.append_column("timestamp", pa.array(stamps, pa.float32())), path)


def filmed(folder: Path, frames: np.ndarray, stamps: list[list[float]], rate: int, fps: int) -> Path:
    """A data set of the older format whose videos hold more pictures than its rows say."""
    describe(folder, "v2.1", "video", fps=fps)
    lines = [{"episode_index": one, "length": len(times)} for one, times in enumerate(stamps)]
    (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for name in ("data/chunk-000", f"videos/chunk-000/{CAMERA}"):
        (folder / name).mkdir(parents=True)
    for one, times in enumerate(stamps):
        numbers = range(len(times))
        table = {"episode_index": [one] * len(times), "frame_index": numbers, "action": numbers}
        parquet.write_table(pa.table(table), path := folder / f"data/chunk-000/episode_{one:06d}.parquet")
        with_stamps(path, times)
        video_file(folder / f"videos/chunk-000/{CAMERA}/episode_{one:06d}.mp4", frames, rate=rate)
    return folder


@pytest.mark.slow
def test_a_jump_of_the_time_stamps_is_a_gap_and_keeps_pictures_and_actions_together(tmp_path: Path) -> None:
    frames, kept = moving(36, 32, 32), [*range(10), *range(22, 36)]
    stamps = [[number / 30 for number in numbers] for numbers in (range(24), kept)]
    folder = filmed(tmp_path / "set", frames, stamps, 30, 30)
    import_recordings([folder], tmp_path / "out", ImportOptions(size=32, hz=30, actions="action"))
    dataset = Dataset.open(tmp_path / "out")
    assert dataset.lengths.tolist() == [24, 10, 14]
    np.testing.assert_array_equal(dataset.video(1), frames[:10])
    np.testing.assert_array_equal(dataset.video(2), frames[22:])
    names = dataset.spec.actions.names
    assert [int(names[one]) for one in dataset.states(2).actions] == list(range(10, 23))

    import_recordings([folder], tmp_path / "alone", ImportOptions(size=32, hz=30))
    np.testing.assert_array_equal(Dataset.open(tmp_path / "alone").video(2), frames[22:])


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "fps"), [(30, 10), (30, 15), (30, 20), (30, 12), (30, 30)])
def test_of_a_faster_video_the_picture_nearest_to_each_time_stamp_is_taken(tmp_path: Path, rate: int, fps: int) -> None:
    frames = moving(36, 32, 32)
    folder = filmed(tmp_path / "set", frames, [[row / fps for row in range(10)]] * 2, rate, fps)
    import_recordings([folder], tmp_path / "out", ImportOptions(size=32, hz=fps))
    nearest = [math.ceil(Fraction(row * rate, fps) - Fraction(1, 2)) for row in range(10)]
    np.testing.assert_array_equal(Dataset.open(tmp_path / "out").video(1), frames[nearest])


def test_time_stamps_between_the_whole_intervals_are_the_times_of_the_frames(tmp_path: Path) -> None:
    stamps = [0.0, 0.1, 0.2, 0.38, 0.4, 0.5, 0.6]
    folder = filmed(tmp_path / "set", moving(36, 32, 32), [stamps], 30, 10)
    recording = LeRobotRecording(folder, camera=None, actions=None, limits=ImportLimits())
    (segment,) = recording.survey().segments
    np.testing.assert_allclose(segment.times_ns / 1e9, stamps, atol=1e-6)
    np.testing.assert_array_equal(next(recording.pictures(0, np.array([3]))), moving(36, 32, 32)[11])


@pytest.mark.slow
@pytest.mark.parametrize("stamps", [[0, 0.1, 0.2, 0.1], [0, 0.1, 0.1, 0.2], [0, 0.1, 0.2, math.inf]])
@pytest.mark.parametrize("actions", [None, "action"])
def test_time_stamps_that_cannot_be_are_refused_in_every_episode(
    tmp_path: Path, stamps: list[float], actions: str | None
) -> None:
    folder = filmed(tmp_path / "set", moving(6, 32, 32), [[0, 0.1, 0.2, 0.3], stamps], 10, 10)
    match = "goes back in time at frame [23] of episode 1|pictures in episode 1 at times that cannot be"
    refused(folder, match, ImportOptions(size=32, actions=actions))


@pytest.mark.slow
def test_time_stamps_agree_with_the_frames_a_second(tmp_path: Path) -> None:
    folder = v3(tmp_path / "set", video(sum(LENGTHS)))
    with_times(folder, 0.1)
    same(folder, video(sum(LENGTHS)))


@pytest.mark.slow
@pytest.mark.parametrize("interval", [0.2, 0.0, float("nan")])
def test_time_stamps_of_another_rate_are_refused(tmp_path: Path, interval: float) -> None:
    folder = v3(tmp_path / "set", video(sum(LENGTHS)))
    with_times(folder, interval)
    refused(folder, rf"says that it has 10 frames a second, but .* of episode 0 are {interval:.3g} s apart")
