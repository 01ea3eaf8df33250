"""Recordings of one time are told of: copies with other bytes, and other cameras of the same moments."""

from __future__ import annotations

from pathlib import Path

import zstandard
from storage.foreign import foxglove_file, steady, video

from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport

OPTIONS = ImportOptions(size=32)
TOLD = "some recordings were made at the same time: "


def drive(path: Path, begin: int = 0, count: int = 12, seed: int = 0) -> Path:
    """A recording that begins at a tick of one clock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return foxglove_file(path, video(count, seed=seed), steady(begin + count)[begin:])


def report(folder: Path) -> ImportReport:
    return import_recordings([folder], folder.parent / "out", OPTIONS)


def test_a_copy_with_other_bytes_is_told_of(tmp_path: Path) -> None:
    first = drive(tmp_path / "in/a.mcap")
    (tmp_path / "in/b.mcap.zstd").write_bytes(zstandard.compress(first.read_bytes()))
    drive(tmp_path / "in/c.mcap", begin=12)
    told = report(tmp_path / "in").advice[0]
    assert told == (
        f"{TOLD}{str(first)!r} and {str(tmp_path / 'in/b.mcap.zstd')!r}. If they are copies, or several cameras of one "
        "robot, leave out all but one, or test episodes show what is trained on."
    )


def test_cameras_with_files_of_their_own_are_told_of(tmp_path: Path) -> None:
    for run in range(3):
        for camera in range(2):
            drive(tmp_path / f"in/run{run}_cam{camera}.mcap", begin=20 * run + camera, seed=2 * run + camera)
    assert "run1_cam1.mcap' (3 such pairs in all). If" in report(tmp_path / "in").advice[0]


def test_recordings_one_after_the_other_are_not(tmp_path: Path) -> None:
    for run in range(3):
        drive(tmp_path / f"in/{run}.mcap", begin=9 * run, seed=run)  # the next one begins while the last one ends
    assert not any(TOLD in told for told in report(tmp_path / "in").advice)


def test_clocks_that_begin_with_each_recording_tell_nothing(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for run in range(2):
        times = [round(1e8 * tick) for tick in range(10)]
        foxglove_file(tmp_path / f"in/{run}.mcap", video(10, seed=run), times)
    assert not any(TOLD in told for told in report(tmp_path / "in").advice)
