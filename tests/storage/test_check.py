"""What a check finds and what a repair keeps, where no environment can help."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from failing_disk import lost
from noise_world import assert_same_episode, files_of, noise_episode, noise_lengths, noise_spec, write_noise

from dmotion_bench.errors import CacheNotWritable, DatasetCorrupt, RecipeMismatch, UsageError
from dmotion_bench.recording.restore import repair_dataset
from dmotion_bench.specs import DatasetRecipe, SplitName
from dmotion_bench.storage.check import check_dataset, table_damages
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.repair import salvage
from dmotion_bench.storage.shard import Footage, file_facts
from dmotion_bench.storage.split import split_episodes
from dmotion_bench.storage.tables import TASKS, write_tasks
from dmotion_bench.storage.writer import DatasetWriter


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0x10
    file.write_bytes(content)


def forge(file: Path) -> None:
    shutil.copy(file.parent / "shard-00000.mcap", file)


DAMAGES: list[Callable[[Path], None]] = [truncate, flip, forge, Path.unlink]


def test_a_sound_data_set_is_sound(tmp_path: Path) -> None:
    report = check_dataset(write_noise(tmp_path / "d").path)
    assert (report.damages, report.labels) == ((), "present")


@pytest.mark.parametrize("kind", ["video", "labels"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_is_found_where_it_is(tmp_path: Path, kind: str, damage: Callable[[Path], None]) -> None:
    path = write_noise(tmp_path / "d").path
    damage(path / kind / "shard-00001.mcap")
    report = check_dataset(path)
    assert [one.file for one in report.damages] == [f"{kind}/shard-00001.mcap"]
    assert report.shards == (1,)


def test_labels_that_were_taken_away_are_no_damage(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    shutil.rmtree(path / "labels")
    report = check_dataset(path)
    assert (report.damages, report.labels) == ((), "missing")


def test_tables_are_made_again_byte_for_byte(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    before = files_of(path)
    flip(path / "episodes.parquet")
    (path / "tasks.parquet").unlink()
    assert [one.file for one in check_dataset(path).damages] == ["episodes.parquet"]
    assert repair_dataset(path).how == "restored"
    assert files_of(path) == before


def test_easier_tasks_than_the_recordings_give_are_found_and_made_again(tmp_path: Path) -> None:
    """With a manifest that agrees the fingerprint is the same, and so would be the board of the leaderboard."""
    honest = write_noise(tmp_path / "d", tasks=3)
    path, before = honest.path, files_of(honest.path)
    easier = [task._replace(goal=task.start + 1) for task in honest.tasks()]
    write_tasks(path, easier)
    manifest = Manifest.read(path)
    dataclasses.replace(manifest, tables={**manifest.tables, TASKS: file_facts(path / TASKS)}).write(path)
    forged = Dataset.open(path)
    assert (forged.fingerprint, forged.tasks()) == (honest.fingerprint, easier)
    assert easier
    [damage] = check_dataset(path).damages
    assert (damage.file, damage.what) == (TASKS, "names other tasks than the recordings give")
    assert list(table_damages(forged)) == [damage]
    assert repair_dataset(path).how == "restored"
    assert files_of(path) == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["video", "labels"])
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("table", [True, False], ids=["table", "no table"])
def test_every_episode_that_can_be_read_is_kept(
    tmp_path: Path, kind: str, damage: Callable[[Path], None], table: bool
) -> None:
    path = write_noise(tmp_path / "d").path
    damage(path / kind / "shard-00001.mcap")
    if not table:
        (path / "episodes.parquet").unlink()
    before = files_of(path)
    done = repair_dataset(path)
    assert done.how == "salvaged"
    assert done.salvaged is not None
    kept = done.salvaged.kept
    assert {0, 1, 2, 6} <= set(kept) < set(range(7))
    assert sorted([*kept, *done.salvaged.lost]) == list(range(7))
    assert files_of(done.salvaged.original) == before  # nothing of the original is lost
    mended = Dataset.open(path)
    assert len(mended) == len(kept)
    lengths = noise_lengths(7)
    for place, number in enumerate(kept):
        assert_same_episode(mended.episode(place), noise_episode(number, lengths[number], mended.spec))
    assert check_dataset(path).damages == ()


def test_of_a_truncated_shard_the_first_episodes_are_kept(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    end = dataset.rows[4].video
    file = dataset.path / "video" / "shard-00001.mcap"
    file.write_bytes(file.read_bytes()[: end.offset + end.size + 10])
    assert salvage(dataset.path).lost == (5,)


@pytest.mark.parametrize("kind", ["video", "labels"])
@pytest.mark.parametrize("table", [True, False], ids=["table", "no table"])
def test_of_bytes_that_the_disk_cannot_read_only_their_episode_is_lost(tmp_path: Path, kind: str, table: bool) -> None:
    dataset = write_noise(tmp_path / "d")
    span = dataset.rows[4].video if kind == "video" else dataset.rows[4].states
    middle = span.offset + span.size // 2
    if not table:
        (dataset.path / "episodes.parquet").unlink()

    with lost(dataset.path / kind / "shard-00001.mcap", range(middle, middle + 1)):
        damages = {damage.file: damage.what for damage in check_dataset(dataset.path).damages}
        done = repair_dataset(dataset.path)

    assert damages[f"{kind}/shard-00001.mcap"] == "cannot be read from the disk: Input/output error"

    assert done.salvaged is not None
    assert done.salvaged.lost == (4,)
    assert check_dataset(dataset.path).damages == ()


def test_a_table_that_the_disk_cannot_read_is_made_again(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    before = files_of(path)
    with lost(path / "episodes.parquet", range(10, 11)):
        assert "cannot be read from the disk" in check_dataset(path).damages[0].what
        assert repair_dataset(path).how == "restored"
    assert files_of(path) == before


def test_without_labels_the_video_is_salvaged(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    shutil.rmtree(path / "labels")
    truncate(path / "video" / "shard-00000.mcap")
    repair_dataset(path)
    assert check_dataset(path).labels == "none"
    assert len(Dataset.open(path)) >= 4


def write_video(path: Path, lengths: Sequence[int] = (2, 4, 6, 3)) -> Dataset:
    """A data set of noise without labels, two episodes a shard."""
    spec = noise_spec()
    recipe = DatasetRecipe(environment="imported", episodes=len(lengths), frames=max(lengths), shard_episodes=2)
    with DatasetWriter.create_or_resume(path, recipe, spec) as writer:
        for index in writer.missing:
            numbers = writer.episodes_of(index)
            writer.write_shard(index, (Footage(frames=noise_episode(n, lengths[n], spec).frames) for n in numbers))
        writer.finish()
    return Dataset.open(path)


def test_a_shard_in_anothers_place_is_salvaged_once(tmp_path: Path) -> None:
    path = write_video(tmp_path / "d").path
    shutil.copy(path / "video" / "shard-00000.mcap", path / "video" / "shard-00001.mcap")
    (path / "episodes.parquet").unlink()
    done = salvage(path)
    assert (done.kept, done.lost) == ((0, 1), (2, 3))
    assert Dataset.open(path).lengths.tolist() == [2, 4]


def test_labels_of_another_data_set_are_not_taken_over(tmp_path: Path) -> None:
    path = write_video(tmp_path / "d").path
    shutil.copytree(write_noise(tmp_path / "labelled", shard_episodes=2).path / "labels", path / "labels")
    assert check_dataset(path).damages == ()
    before = files_of(path)
    (path / "episodes.parquet").unlink()
    assert repair_dataset(path).how == "restored"
    assert files_of(path) == before


def test_a_salvage_that_is_interrupted_at_its_end_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_noise(tmp_path / "d").path
    (path / "video" / "shard-00001.mcap").unlink()
    before, rename = files_of(path), Path.rename

    def interrupted(self: Path, target: Path) -> Path:
        if self.parent.name == "repairing":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        salvage(path)
    assert files_of(path) == before
    monkeypatch.undo()
    assert salvage(path).lost == (3, 4, 5)


def test_a_salvaged_data_set_is_not_extended(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    (path / "video" / "shard-00001.mcap").unlink()
    repair_dataset(path)
    recipe = Dataset.open(path).recipe
    with pytest.raises(RecipeMismatch, match="lacks episodes"):
        DatasetWriter.create_or_resume(path, recipe, Dataset.open(path).spec)


def test_the_original_of_an_earlier_repair_is_not_overwritten(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    (tmp_path / "damaged" / "d").mkdir(parents=True)
    (path / "video" / "shard-00001.mcap").unlink()
    before = files_of(path)
    with pytest.raises(DatasetCorrupt, match="damaged/d"):
        repair_dataset(path)
    assert files_of(path) == before


def test_what_no_repair_left_behind_is_not_deleted(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d").path
    (path / "video" / "shard-00001.mcap").unlink()
    mine = write_noise(tmp_path / "repairing" / "d").path
    before = files_of(path), files_of(mine)
    with pytest.raises(UsageError, match="repairing/d' is in the way of the repair"):
        repair_dataset(path)
    assert (files_of(path), files_of(mine)) == before
    shutil.rmtree(mine)
    mine.mkdir()
    (mine / "notes.txt").write_text("of mine")
    with pytest.raises(UsageError, match="repairing/d' is in the way of the repair"):
        repair_dataset(path)
    assert (mine / "notes.txt").exists()
    (mine / "notes.txt").unlink()
    assert repair_dataset(path).how == "salvaged"


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_neither_read_nor_waited_for(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = write_noise(tmp_path / "d").path
    (path / "video" / "shard-00001.mcap").unlink()
    make(path / "video" / "shard-00001.mcap")
    done = repair_dataset(path).salvaged
    assert done is not None
    assert done.lost == (3, 4, 5)


def test_a_folder_in_the_place_of_the_cache_is_found_and_deleted(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    dataset.cache_file.path.mkdir(parents=True)
    (damage,) = check_dataset(dataset.path).damages
    assert (damage.file, damage.what) == (f"cache/{dataset.cache_file.path.name}", "is a folder")
    with pytest.raises(CacheNotWritable, match="a folder has the name 'frames-"):
        dataset.cache()
    assert repair_dataset(dataset.path).how == "cache"
    assert check_dataset(dataset.path).damages == ()
    dataset.cache_file.path.with_name("frames-0.arrow").mkdir()  # of an earlier state of the data set
    assert len(dataset.cache().frames) == dataset.lengths.sum()


def test_where_nothing_can_be_read_nothing_is_touched(tmp_path: Path) -> None:
    path = write_noise(tmp_path / "d", episodes=2).path
    (path / "video" / "shard-00000.mcap").write_bytes(b"")
    before = files_of(path)
    with pytest.raises(DatasetCorrupt, match="not one episode"):
        repair_dataset(path)
    assert files_of(path) == before


def test_a_check_divides_no_episodes_into_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, asked = write_noise(tmp_path / "d").path, list[int]()

    def counted(seed: int, episodes: int, *more: Any) -> dict[SplitName, np.ndarray]:
        asked.append(episodes)
        return split_episodes(seed, episodes, *more)

    monkeypatch.setattr("dmotion_bench.storage.dataset.split_episodes", counted)
    assert check_dataset(path).damages == ()
    dataset = Dataset.open(path)
    assert asked == []
    for name in ("train", "test"):
        np.testing.assert_array_equal(dataset.split(name), split_episodes(dataset.recipe.seed, len(dataset))[name])
    assert asked == [len(dataset)]
