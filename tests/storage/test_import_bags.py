"""A ROS 2 bag in several files is one recording: its parts stay on one side of the split."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from storage.foreign import foxglove_file, steady

from dmotion_bench.errors import RecipeMismatch
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports import search
from dmotion_bench.storage.imports.bags import METADATA, bags_of, listed_files
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.storage.tables import EPISODES

SMALL = ImportOptions(size=16)
HEAD = "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n"
LISTED = f"{HEAD}  relative_file_paths:\n"


def bag(folder: Path, parts: int, colour: int = 0) -> Path:
    """A bag as rosbag2 records it into several files, with four pictures in each; colours follow one another."""
    folder.mkdir(parents=True)
    names = [f"{folder.name}_{part}.mcap" for part in range(parts)]
    times = [t_ns + colour * 1_000_000_000 for t_ns in steady(4 * parts)]
    for part, name in enumerate(names):
        frames = np.full((4, 16, 16, 3), colour, np.uint8)
        frames[:, 0, 0, 1] = part
        foxglove_file(folder / name, frames, times[4 * part : 4 * part + 4])
    listed = "".join(f"    - {name}\n" for name in names)
    (folder / METADATA).write_text(f"{LISTED}{listed}  duration:\n    nanoseconds: 1\n")
    return folder


def test_all_files_of_a_bag_are_one_recording(tmp_path: Path) -> None:
    folder = bag(tmp_path / "drive", 12)
    report = import_recordings([folder], tmp_path / "out", SMALL)
    assert report.advice == (
        f"12 files of {str(folder)!r} are one recording: its 'metadata.yaml' lists them as parts of one bag.",
        "all episodes are parts of one recording, so test episodes are parts of what is trained on. Import more "
        "recordings for an honest test.",
    )
    dataset = Dataset.open(report.path)
    assert [int(dataset.video(episode)[0, 0, 0, 1]) for episode in range(12)] == list(range(12))

    (folder / METADATA).unlink()
    before = import_recordings([folder], tmp_path / "before", SMALL)
    assert before.advice == ()
    for name in ("dataset.json", EPISODES):  # a split by episode is the same in both
        assert (report.path / name).read_bytes() == (before.path / name).read_bytes()


def test_the_files_of_a_bag_stay_on_one_side(tmp_path: Path) -> None:
    folders = [bag(tmp_path / f"in/run{number}", 3, colour=10 * number) for number in range(12)]
    report = import_recordings([tmp_path / "in"], tmp_path / "out", SMALL)
    assert report.advice == (
        f"36 files are 12 recordings, as each 'metadata.yaml' lists the parts of one bag: {str(folders[0])!r}, "
        f"{str(folders[1])!r}, {str(folders[2])!r} and 9 more.",
    )
    dataset = Dataset.open(report.path)
    assert dataset.recipe.parameters["bags"] == 12
    assert pq.read_table(dataset.path / EPISODES)["source"].to_pylist() == [episode // 3 for episode in range(36)]
    sides = [{int(dataset.video(int(one))[0, 8, 8, 0]) for one in dataset.split(name)} for name in SPLIT_NAMES]
    assert sum(map(len, sides)) == len(set.union(*sides)) == 12

    import_fleet([tmp_path / "in"], tmp_path / "many", SMALL, SerialExecutor())
    for name in ("dataset.json", EPISODES, "video/shard-00000.mcap"):
        assert (tmp_path / "many" / name).read_bytes() == (report.path / name).read_bytes()


def test_an_import_that_did_not_know_bags_is_told_from_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(12):
        bag(tmp_path / f"in/run{number}", 3, colour=10 * number)
    halves = ImportOptions(size=16, hz=20, frames_per_episode=4)
    with monkeypatch.context() as earlier:
        earlier.setattr(search, "bags_of", lambda files: {})
        import_recordings([tmp_path / "in"], tmp_path / "out", halves)
    with pytest.raises(
        RecipeMismatch, match=r"an earlier version of dmbench .* with parts of one recording in training"
    ):
        import_recordings([tmp_path / "in"], tmp_path / "out", halves)


def test_files_are_of_a_bag_however_they_are_named(tmp_path: Path) -> None:
    folder, other = bag(tmp_path / "drive", 3), bag(tmp_path / "other", 1)
    (tmp_path / "links").mkdir()
    (tmp_path / "links/first.mcap").symlink_to(folder / "drive_0.mcap")
    (folder / "drive_1.mcap").rename(folder / "drive_1.mcap.zstd")  # compressed after it was recorded
    (folder / "more.mcap").touch()
    files = [folder / "drive_2.mcap", tmp_path / "links/first.mcap", folder / "drive_1.mcap.zstd"]
    assert bags_of([*files, folder / "more.mcap", other / "other_0.mcap"]) == dict.fromkeys(files, folder)
    assert bags_of(files[:1]) == {}


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (f"{LISTED}    - a_0.mcap\n    - a_1.mcap\n", ["a_0.mcap", "a_1.mcap"]),
        (f"{LISTED}  - 'a 0.mcap'\n  - \"a/a_1.mcap\"\n  files:\n  - path: b", ["a 0.mcap", "a_1.mcap"]),
        (f"{LISTED}  -\n    a_0.mcap\n  - a_1.mcap\n  message_count: 3\n", ["a_0.mcap", "a_1.mcap"]),
        (LISTED, []),
        (HEAD, []),
        ("\xff\x00", []),
        ("", []),
    ],
)
def test_the_list_of_a_bag_s_files(tmp_path: Path, text: str, names: list[str]) -> None:
    (tmp_path / METADATA).write_bytes(text.encode("latin-1"))
    assert listed_files(tmp_path / METADATA) == names


def test_a_long_description_is_read_line_by_line(tmp_path: Path) -> None:
    (tmp_path / METADATA).write_text("abc\n" * 300_000 + LISTED + "    - a_0.mcap\n")
    tracemalloc.start()
    try:
        assert listed_files(tmp_path / METADATA) == ["a_0.mcap"]
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_a_folder_without_a_description_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / METADATA).mkdir()
    assert listed_files(tmp_path / METADATA) == listed_files(tmp_path / "none.yaml") == []
