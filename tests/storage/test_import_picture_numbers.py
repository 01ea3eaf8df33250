"""Numbers that are missing in the names of pictures: the pictures before and after them are not neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from storage.foreign import compressed, video

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.picture_numbers import begun_anew, hz_by_times, repeated_with_others, steps_between

OPTIONS = ImportOptions(size=32, source_hz=10)
T0 = 1_700_000_000


def fill(folder: Path, names: Sequence[str], seed: int = 0) -> np.ndarray:
    """A folder with a picture of each name, and the pictures."""
    folder.mkdir(parents=True)
    frames = video(len(names), seed=seed)
    for name, frame in zip(names, frames, strict=True):
        (folder / name).write_bytes(compressed(frame, "png"))
    return frames


def imported(folder: Path, options: ImportOptions = OPTIONS) -> tuple[ImportReport, Dataset]:
    report = import_recordings([folder], folder.parent / "out", options)
    return report, Dataset.open(report.path)


def test_a_jump_of_several_pictures_is_no_step(tmp_path: Path) -> None:
    with_gap = [f"frame_{number}.png" for number in [*range(10), *range(14, 25)]]
    first = fill(tmp_path / "run/ep0", with_gap)
    fill(tmp_path / "run/ep1", with_gap, seed=1)
    whole = fill(tmp_path / "run/ep2", [f"frame_{number}.png" for number in range(7)], seed=2)
    report, dataset = imported(tmp_path / "run")
    assert dataset.lengths.tolist() == [10, 11, 10, 11, 7]
    np.testing.assert_array_equal(dataset.video(0), first[:10])
    np.testing.assert_array_equal(dataset.video(1), first[10:])
    np.testing.assert_array_equal(dataset.video(4), whole)
    told, gaps = report.advice[:2]
    assert told.startswith("numbers are missing in the names of the pictures, in 2 places of 2 folders in ")
    assert gaps.startswith("pictures are missing in 2 places, for 0.5 ")


def test_one_lost_picture_is_replaced_by_the_one_before(tmp_path: Path) -> None:
    frames = fill(tmp_path / "run", [f"{number:04d}.png" for number in (0, 2, 4, 8, 10)])
    report, dataset = imported(tmp_path / "run")
    np.testing.assert_array_equal(dataset.video(0), frames[[0, 1, 2, 2, 3, 4]])
    assert (report.repeated, report.source_hz) == (1, pytest.approx(8))
    assert f"in 1 place of {str(tmp_path / 'run')!r}: " in report.advice[0]


@pytest.mark.parametrize(("scale", "digits"), [(1, 2), (1, 3), (1, 9), (10**3, 0), (10**6, 0), (10**9, 0)], ids=str)
def test_times_in_names_tell_a_rate(tmp_path: Path, scale: int, digits: int) -> None:
    times = [(100 * T0 + 4 * number) * scale for number in range(20) if number != 12]
    names = [f"left_{time // 100}{f'.{time % 100 * 10**digits // 100:0{digits}}' if digits else ''}" for time in times]
    assert hz_by_times(names) == 25
    assert hz_by_times([f"{number}.png" for number in range(20)]) is None
    fill(tmp_path / "run", [f"{name}.png" for name in names])
    assumed, _ = imported(tmp_path / "run", ImportOptions(size=32))
    assert "the names of the pictures are times, as of 25 pictures a second: say '--source-hz 25'." in assumed.advice
    said = import_recordings([tmp_path / "run"], tmp_path / "said", ImportOptions(size=32, source_hz=25))
    assert not any("are times" in one for one in said.advice)


def test_a_gap_may_be_bridged(tmp_path: Path) -> None:
    frames = fill(tmp_path / "run", [f"{number}.png" for number in (0, 1, 2, 3, 7)])
    _, dataset = imported(tmp_path / "run", replace(OPTIONS, max_gap_s=1))
    np.testing.assert_array_equal(dataset.video(0), frames[[0, 1, 2, 3, 3, 3, 3, 4]])


@pytest.mark.parametrize(
    ("per_second", "form"), [(1, ".6f"), (1, ".1f"), (10**3, ".0f"), (10**6, ".0f"), (10**9, ".0f")]
)
def test_a_pause_between_times_ends_an_episode(tmp_path: Path, per_second: int, form: str) -> None:
    jitter = np.random.default_rng(0).uniform(-0.1, 0.1, 12)
    seconds = [T0 + (place + off + 5 * (place > 7)) / 2 for place, off in enumerate(jitter)]
    names = [f"{one * per_second:{form}}.png" for one in seconds]
    frames = fill(tmp_path / "run", names)
    report, dataset = imported(tmp_path / "run")
    assert dataset.lengths.tolist() == [8, 4]
    np.testing.assert_array_equal(np.concatenate([dataset.video(0), dataset.video(1)]), frames)
    assert report.advice[0].startswith("numbers are missing")


@pytest.mark.parametrize(
    ("numbers", "steps"),
    [
        ([0, 1, 2, 3], [1, 1, 1]),
        ([5, 10, 15, 30, 35], [1, 1, 3, 1]),
        (["x0001_left2", "x0002_left2", "x0003_left2", "x0009_left2"], [1, 1, 6]),
        (["7_0", "8_1", "9_2", "11_4"], [1, 1, 2]),
        ([0, 1, 2, 3, 10**40], [1, 1, 1, 1_000_000]),
        ([f"{place}_{T0 + place + 9 * (place > 2)}000" for place in range(6)], [1, 1, 10, 1, 1]),
        (["20240101_0001", "20240101_0002", "20240101_0003", "20240101_0007"], [1, 1, 4]),
        ([0, 1, 5], None),  # too few to have a usual difference
        ([3, 17, 58, 61, 104, 120], None),
        ([0, 1, 2, 3, 3.5], None),
        ([0, 2, 4, 7, 9], None),
        (["1_9", "1_10", "2_0", "2_1"], None),
        (["1.8", "1.9", "1.10", "1.20"], None),
        (["20240101_120057", "20240101_120058", "20240101_120059", "20240101_120100"], None),
        ([20240101120057, 20240101120058, 20240101120059, 20240101120100], None),
        ([f"{T0 + one}000" for one in (0, 1, 30, 31, 90, 200, 201, 400)], None),
        (["left", "left", "left", "left"], None),
    ],
)
def test_steps_between_names(numbers: Sequence[object], steps: list[int] | None) -> None:
    found = steps_between([f"{number}.png" for number in numbers])
    assert (None if found is None else found.tolist()) == steps


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ([f"{t:04d}_{camera}" for t in range(20) for camera in (0, 1)], (["0", "1"], 20)),
        ([f"cam{camera}_{t:04d}" for camera in (2, 0, 1) for t in range(20)], (["2", "0", "1"], 20)),
        ([f"run3_cam{camera}_{t}" for camera in (0, 1) for t in range(20 - camera)], (["0", "1"], 20)),
        ([f"{t:04d}_{t % 2}" for t in range(20)], None),
        ([f"{t // 10}_{t % 10}" for t in range(100)], None),  # a number in two parts
        ([f"run3_{t}" for t in range(20)], None),
        (["1_9", "1_10", "2_0", "2_1"], None),
        (["left", "left"], None),
        ([], None),
    ],
)
def test_a_number_that_has_few_values_with_all_others(names: list[str], found: tuple[list[str], int] | None) -> None:
    assert repeated_with_others([f"{name}.png" for name in names]) == found


def test_cameras_that_a_number_tells_apart_are_told_of(tmp_path: Path) -> None:
    for episode in range(3):
        fill(tmp_path / f"run/ep{episode}", [f"{t:04d}_{camera}.png" for t in range(5) for camera in (0, 1)], episode)
    report, _ = imported(tmp_path / "run")
    assert report.advice[0].startswith(
        f"a number in the names of the pictures in {str(tmp_path / 'run/ep0')!r} is 0 or 1 with each of 5 others, and "
        "so in 2 more folders, as the number of a camera or of an episode is"
    )
    assert "move those of each into a folder of its own; '--camera'" in report.advice[0]


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ([f"episode_{one:03d}_frame_{t:04d}" for one in range(12) for t in range(5 + one % 3)], ("0", 12)),
        ([f"{one}_{t}" for one in range(3, 5) for t in range(1, 7 + one)], ("1", 2)),
        ([f"ep{one}_cam2_{t}" for one in range(9) for t in range(8)], ("0", 9)),
        ([f"ep{one}_f{t}" for one in range(12) for t in range(100)], ("0", 12)),
        ([f"{t // 100}_{t % 100:02d}" for t in range(350)], None),  # a number in two parts
        ([f"{T0 + t // 10}_{t % 10}00000000" for t in range(45)], None),  # seconds and nanoseconds
        ([f"{t // 60}-{t % 60}" for t in range(130)], None),  # minutes and seconds
        ([f"20240101_12{t // 60:02d}{t % 60:02d}" for t in range(130)], None),
        ([f"{one}_{t}" for one in range(4) for t in range(7 * one, 7 * one + 7 + one)], None),
        ([f"run3_{t}" for t in range(20)], None),
        ([f"{t}_{camera}" for t in range(20) for camera in (0, 1)], None),
        ([f"{t}.5" for t in range(20)], None),
        (["left", "left"], None),
        ([], None),
    ],
)
def test_a_number_that_begins_anew(names: list[str], found: tuple[str, int] | None) -> None:
    assert begun_anew([f"{name}.png" for name in names]) == found


def test_episodes_that_share_a_folder_are_told_of(tmp_path: Path) -> None:
    fill(tmp_path / "run", [f"episode_{one:02d}_frame_{t:03d}.png" for one in range(11) for t in range(3 + one % 2)])
    report, _ = imported(tmp_path / "run")
    assert report.advice[0] == (
        f"a number in the names of the pictures in {str(tmp_path / 'run')!r} begins anew at 0 11 times, as the number "
        "of a picture does with each episode, and all of them become one recording in the order of their names. If "
        "they are of several episodes, move those of each into a folder of its own."
    )


def test_random_numbers_stay_one_episode_without_a_remark(tmp_path: Path) -> None:
    frames = fill(tmp_path / "run", [f"{number}.png" for number in (3, 17, 58, 61, 104, 120)])
    report, dataset = imported(tmp_path / "run")
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert not any("missing" in told for told in report.advice)


def test_numbers_that_no_clock_can_reach(tmp_path: Path) -> None:
    fill(tmp_path / "run", [f"{number}.png" for number in [*range(9), *(place * 10**30 for place in range(1, 6))]])
    with pytest.raises(RecordingImportError, match=r"has 5,000,009 pictures at 0\.001 Hz, more than a century"):
        imported(tmp_path / "run", replace(OPTIONS, source_hz=0.001, hz=0.01))
