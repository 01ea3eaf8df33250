"""Parts of one recording stay on one side of the split, where there are enough recordings."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from storage.foreign import compressed
from storage.test_forged import replace_table

from dmotion_bench.errors import DatasetCorrupt, RecipeMismatch, RecordingImportError
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.specs import SPLIT
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot import export_lerobot
from dmotion_bench.storage.imports import import_plan
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.lerobot_layout import SOURCE
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.limits import MOST_EPISODES
from dmotion_bench.storage.repair import rebuild_tables, salvage
from dmotion_bench.storage.shard import VIDEO, shard_path
from dmotion_bench.storage.split import SPLIT_NAMES, split_episodes
from dmotion_bench.storage.summary import summarize
from dmotion_bench.storage.tables import EPISODES

LISTED = "meta/episodes/chunk-000/file-000.parquet"
HALVES = ImportOptions(size=16, frames_per_episode=4, source_hz=10)
HONEST = "Import more recordings for an honest test."


def recordings(folder: Path, count: int, pictures: int = 8) -> Path:
    """Folders of pictures; all pictures of one have the same colour, which no other has."""
    for number in range(count):
        (folder / f"run{number}").mkdir(parents=True)
        for picture in range(pictures):
            frame = np.full((16, 16, 3), 10 * number, np.uint8)
            (folder / f"run{number}" / f"{picture}.png").write_bytes(compressed(frame, "png"))
    return folder


def sources(dataset: Dataset, split: str) -> list[int]:
    """Which recordings the episodes of a split show."""
    assert split in SPLIT_NAMES
    return [int(dataset.video(int(episode))[0, 0, 0, 0]) // 10 for episode in dataset.split(split)]


def test_parts_of_one_recording_are_on_one_side(tmp_path: Path) -> None:
    report = import_recordings([recordings(tmp_path / "in", 12)], tmp_path / "out", HALVES)
    dataset = Dataset.open(report.path)
    assert (report.episodes, report.advice) == (24, ())
    sides = {split: sources(dataset, split) for split in SPLIT_NAMES}
    assert {split: len(shown) for split, shown in sides.items()} == {"train": 20, "validation": 2, "test": 2}
    assert all(sorted(set(shown)) == sorted(shown[::2]) for shown in sides.values())
    assert not set(sides["test"]) & {*sides["train"], *sides["validation"]}

    table = pq.read_table(dataset.path / EPISODES)
    assert table["source"].to_pylist() == [episode // 2 for episode in range(24)]
    told = {name: np.flatnonzero([side == name for side in table["split"].to_pylist()]) for name in SPLIT_NAMES}
    for name, members in told.items():
        np.testing.assert_array_equal(members, dataset.split(name))
    assert summarize(dataset.path)["split"] == {"train": 20, "validation": 2, "test": 2}
    assert not check_dataset(dataset.path).damages


def test_several_machines_make_the_same_bytes(tmp_path: Path) -> None:
    given = recordings(tmp_path / "in", 12)
    import_recordings([given], tmp_path / "one", HALVES)
    import_fleet([given], tmp_path / "many", HALVES, SerialExecutor())
    for name in ("dataset.json", EPISODES, "video/shard-00000.mcap"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "many" / name).read_bytes()


def test_recordings_that_are_not_cut_are_split_as_before(tmp_path: Path) -> None:
    whole = dataclasses.replace(HALVES, frames_per_episode=8)
    dataset = Dataset.open(import_recordings([recordings(tmp_path / "in", 12)], tmp_path / "out", whole).path)
    assert SPLIT not in dataset.recipe.parameters
    assert "source" not in pq.read_schema(dataset.path / EPISODES).names
    assert b"source" not in shard_path(dataset.path, VIDEO, 0).read_bytes()
    for name, members in split_episodes(0, 12).items():
        np.testing.assert_array_equal(dataset.split(name), members)


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (1, f"all episodes are parts of one recording, so test episodes are parts of what is trained on. {HONEST}"),
        (
            9,
            "the episodes are parts of 9 recordings, and 10 are needed to keep parts together, so test episodes are "
            f"parts of what is trained on. {HONEST}",
        ),
    ],
)
def test_too_few_recordings_are_split_by_episode_and_it_is_said(tmp_path: Path, count: int, said: str) -> None:
    given = recordings(tmp_path / "in", count, pictures=40)
    report = import_recordings([given], tmp_path / "out", HALVES)
    dataset = Dataset.open(report.path)
    assert report.advice == (said,)
    assert SPLIT not in dataset.recipe.parameters
    np.testing.assert_array_equal(dataset.split("test"), split_episodes(0, 10 * count)["test"])


def test_an_earlier_import_keeps_its_split_and_is_told_from_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = recordings(tmp_path / "in", 12)
    with monkeypatch.context() as earlier:
        earlier.setattr(import_plan, "FEWEST_EPISODES", 1000)
        dataset = Dataset.open(import_recordings([given], tmp_path / "out", HALVES).path)
    np.testing.assert_array_equal(dataset.split("test"), split_episodes(0, 24)["test"])
    assert not check_dataset(dataset.path).damages
    with pytest.raises(
        RecipeMismatch, match=r"an earlier version of dmbench .* with parts of one recording in training"
    ):
        import_recordings([given], tmp_path / "out", HALVES)
    with pytest.raises(RecipeMismatch, match=r"other options: '--size' is [0-9]+ there and 32 here; name"):
        import_recordings([given], tmp_path / "out", dataclasses.replace(HALVES, size=32))


def test_repairs_keep_parts_together(tmp_path: Path) -> None:
    dataset = Dataset.open(import_recordings([recordings(tmp_path / "in", 12)], tmp_path / "out", HALVES).path)
    before = (dataset.path / EPISODES).read_bytes()
    (dataset.path / EPISODES).unlink()
    rebuild_tables(dataset.path, dataset.manifest)
    assert (dataset.path / EPISODES).read_bytes() == before

    file, lost = shard_path(dataset.path, VIDEO, 0), dataset.rows[1].video
    damaged = bytearray(file.read_bytes())
    damaged[lost.offset + lost.size // 2] ^= 0xFF
    file.write_bytes(damaged)
    assert salvage(dataset.path).lost == (1,)
    kept = Dataset.open(dataset.path)
    assert kept.rows.sources is not None
    assert kept.rows.sources.tolist() == [0, *(episode // 2 for episode in range(2, 24))]
    assert not set(sources(kept, "test")) & {*sources(kept, "train"), *sources(kept, "validation")}


def test_an_export_and_its_import_keep_parts_together(tmp_path: Path) -> None:
    seeded = dataclasses.replace(HALVES, seed=3)
    before = Dataset.open(import_recordings([recordings(tmp_path / "in", 12)], tmp_path / "out", seeded).path)
    exported = export_lerobot(before, tmp_path / "lerobot", labels=False).path
    timed = dataclasses.replace(seeded, source_hz=None)
    again = Dataset.open(import_recordings([exported], tmp_path / "again", timed).path)
    assert again.rows.sources is not None
    assert again.rows.sources.tolist() == [episode // 2 for episode in range(24)]
    for name in SPLIT_NAMES:
        np.testing.assert_array_equal(again.split(name), before.split(name))
    several = import_fleet([exported], tmp_path / "several", timed, SerialExecutor())
    assert (several.path / EPISODES).read_bytes() == (again.path / EPISODES).read_bytes()

    table = exported / LISTED
    forged = pq.read_table(table)
    place = forged.column_names.index(SOURCE)
    pq.write_table(forged.set_column(place, SOURCE, pa.array([-1] * 24)), table)
    with pytest.raises(RecordingImportError, match="says that an episode is a part of the recording '-1'"):
        import_recordings([exported], tmp_path / "forged", timed)


def test_each_source_has_the_side_that_an_episode_of_its_number_has() -> None:
    parts = np.repeat(np.arange(40), 3)
    by_source, by_episode = split_episodes(7, 120, parts), split_episodes(7, 40)
    for name in SPLIT_NAMES:
        assert by_source[name].tolist() == [3 * one + part for one in by_episode[name] for part in range(3)]


@pytest.mark.parametrize("number", [-1, MOST_EPISODES])
def test_a_table_with_a_source_that_cannot_be_is_refused(tmp_path: Path, number: int) -> None:
    path = import_recordings([recordings(tmp_path / "in", 10)], tmp_path / "out", HALVES).path
    table = pq.read_table(path / EPISODES)
    forged = table.set_column(len(table.columns) - 1, table.schema.field("source"), pa.array([number] * len(table)))
    replace_table(path, EPISODES, forged)
    with pytest.raises(DatasetCorrupt, match="is a part of a recording of no possible number"):
        Dataset.open(path)
