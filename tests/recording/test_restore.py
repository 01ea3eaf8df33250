"""What the recipe can make again is restored byte for byte; what it cannot is salvaged."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as parquet
import pytest
from killed_writes import each_kill
from noise_world import files_of

from dmotion_bench.errors import DatasetCorrupt, RecordingFailed
from dmotion_bench.recording import restore
from dmotion_bench.recording.restore import repair_dataset
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import Manifest, Replay

RECIPE = DatasetRecipe(environment="grid_world", episodes=10, frames=5, tasks=2, shard_episodes=4)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    record_dataset(tmp_path / "d", RECIPE)
    return tmp_path / "d"


def test_a_sound_data_set_is_left_alone(dataset: Path) -> None:
    before = files_of(dataset)
    assert repair_dataset(dataset).how == "sound"
    assert files_of(dataset) == before


def test_damaged_shards_and_tables_come_back_byte_for_byte(dataset: Path) -> None:
    before = files_of(dataset)
    (dataset / "video" / "shard-00000.mcap").write_bytes(b"nothing left")
    (dataset / "labels" / "shard-00002.mcap").unlink()
    (dataset / "episodes.parquet").write_bytes(b"")
    done = repair_dataset(dataset)
    assert (done.how, done.shards) == ("restored", (0, 2))
    assert files_of(dataset) == before


def test_a_cache_that_is_damaged_as_well_is_deleted(dataset: Path) -> None:
    cache = Dataset.open(dataset).cache_file
    Dataset.open(dataset).cache()
    with cache.path.open("r+b") as file:
        file.seek(100_000)
        file.write(b"other pixels")
    (dataset / "video" / "shard-00000.mcap").write_bytes(b"nothing left")
    assert repair_dataset(dataset).how == "restored"
    assert check_dataset(dataset).damages == ()


def test_labels_that_were_taken_away_come_back(dataset: Path) -> None:
    before = files_of(dataset)
    shutil.rmtree(dataset / "labels")
    assert repair_dataset(dataset).how == "restored"
    assert files_of(dataset) == before


def test_a_forged_table_is_told_from_the_shards_and_made_again(dataset: Path) -> None:
    before, table = files_of(dataset), dataset / "episodes.parquet"
    rows = parquet.read_table(table)
    name = next(name for name in rows.column_names if name.startswith("states") and "offset" in name)
    moved = pc.add(rows[name], pa.scalar(7, rows[name].type))
    parquet.write_table(rows.set_column(rows.column_names.index(name), rows.schema.field(name), moved), table)
    manifest = json.loads((dataset / "dataset.json").read_text())
    content = table.read_bytes()
    manifest["tables"]["episodes.parquet"] |= {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    (dataset / "dataset.json").write_text(json.dumps(manifest, indent=2))

    assert {(damage.file, damage.shard) for damage in check_dataset(dataset).damages} == {("episodes.parquet", None)}
    assert repair_dataset(dataset).how == "restored"
    assert files_of(dataset) == before


@pytest.mark.slow
def test_damage_that_shows_only_with_sound_tables_is_mended_as_well(dataset: Path) -> None:
    file, manifest = dataset / "labels" / "shard-00000.mcap", dataset / "dataset.json"
    before, at = file.read_bytes(), Dataset.open(dataset).rows[0].masks.offset
    file.write_bytes(before[: at + 60] + b"garbled!" + before[at + 68 :])
    digests = [hashlib.sha256(one).hexdigest() for one in (before, file.read_bytes())]
    manifest.write_text(manifest.read_text().replace(*digests))  # as a forger would: the hash is right
    assert [damage.shard for damage in check_dataset(dataset).damages] == [0]
    (dataset / "episodes.parquet").write_bytes(b"")
    done = repair_dataset(dataset)
    assert done.salvaged is not None
    assert done.salvaged.lost == (0,)
    assert check_dataset(dataset).damages == ()


def test_an_environment_with_other_objects_than_the_manifest_is_not_recorded_anew(dataset: Path) -> None:
    manifest = json.loads((dataset / "dataset.json").read_text())
    del manifest["environment"]["objects"][0]
    (dataset / "dataset.json").write_text(json.dumps(manifest))
    (dataset / "video" / "shard-00000.mcap").unlink()
    with pytest.raises(DatasetCorrupt, match="record it anew with 'dmbench record'"):
        repair_dataset(dataset)  # the labels of every episode have an object more than the manifest


def test_an_environment_that_draws_differently_now_is_not_mixed_in(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after an upgrade of a simulator: the shard that it makes today is not the one that is lost."""
    record = restore.record_shard

    def differently(job: restore.ShardJob) -> object:
        return record(dataclasses.replace(job, recipe=dataclasses.replace(job.recipe, seed=1)))

    monkeypatch.setattr(restore, "record_shard", differently)
    kept = Dataset.open(dataset).video(9)
    (dataset / "video" / "shard-00000.mcap").unlink()
    done = repair_dataset(dataset)
    assert done.how == "salvaged"
    assert done.salvaged is not None
    assert done.salvaged.lost == (0, 1, 2, 3)
    assert (Dataset.open(dataset).video(5) == kept).all()
    assert check_dataset(dataset).damages == ()


def test_an_environment_that_is_not_installed_is_no_obstacle(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restore, "is_environment", lambda name: False)
    (dataset / "video" / "shard-00001.mcap").unlink()
    done = repair_dataset(dataset)
    assert done.salvaged is not None
    assert done.salvaged.kept == (0, 1, 2, 3, 8, 9)


def test_an_environment_that_fails_now_is_no_obstacle(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(job: restore.ShardJob) -> object:
        raise RecordingFailed("the environment 'grid_world' raised KeyError in 'step'.")

    monkeypatch.setattr(restore, "record_shard", failing)
    (dataset / "video" / "shard-00001.mcap").unlink()
    assert repair_dataset(dataset).how == "salvaged"
    assert check_dataset(dataset).damages == ()


def test_a_repair_that_was_killed_leaves_nothing_in_the_way(dataset: Path) -> None:
    before = files_of(dataset)
    (dataset / "video" / "shard-00000.mcap").unlink()
    (dataset / "repairing" / "video").mkdir(parents=True)
    (dataset / "repairing" / "video" / "shard-00000.mcap").write_bytes(b"half")
    repair_dataset(dataset)
    assert files_of(dataset) == before


def test_the_packages_that_made_a_data_set_stay_named(dataset: Path) -> None:
    manifest = dataset / "dataset.json"
    content = json.loads(manifest.read_text())
    content["versions"]["numpy"] = "1.99"
    manifest.write_text(json.dumps(content))
    (dataset / "tasks.parquet").unlink()
    repair_dataset(dataset)
    record_dataset(dataset, RECIPE)  # complete: nothing to do
    assert json.loads(manifest.read_text())["versions"]["numpy"] == "1.99"


def test_what_is_salvaged_names_the_packages_that_recorded_it(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restore, "is_environment", lambda name: False)
    manifest = Manifest.read(dataset)
    before = {**manifest.versions, "numpy": "1.99", "zstandard": "0.1"}
    dataclasses.replace(manifest, versions=before).write(dataset)
    (dataset / "video" / "shard-00001.mcap").unlink()
    assert repair_dataset(dataset).how == "salvaged"
    after = dict(Manifest.read(dataset).versions)
    assert after == before | {"zstandard": manifest.versions["zstandard"]}


@pytest.mark.parametrize(("differs", "tasks"), [("", 2), ("frame 3 of episode 0", 0)])
def test_a_recording_that_does_not_repeat_has_no_tasks_after_a_salvage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, differs: str, tasks: int
) -> None:
    dataset = tmp_path / "long"
    record_dataset(dataset, dataclasses.replace(RECIPE, frames=30))
    monkeypatch.setattr(restore, "is_environment", lambda name: False)
    replay = Replay(episodes=(0, 9), differs=differs)
    dataclasses.replace(Manifest.read(dataset), replay=replay).write(dataset)
    (dataset / "video" / "shard-00002.mcap").unlink()
    assert repair_dataset(dataset).how == "salvaged"
    assert len(Dataset.open(dataset).tasks()) == tasks


@pytest.mark.slow
def test_a_repair_that_was_killed_at_any_moment_ends_as_one_that_was_not(tmp_path: Path) -> None:
    recipe = dataclasses.replace(RECIPE, episodes=2, shard_episodes=1)
    record_dataset(tmp_path / "sound", recipe)

    def damage_and_repair(moment: int) -> None:
        path = tmp_path / f"{moment}" / "d"
        shutil.copytree(tmp_path / "sound", path)
        (path / "video/shard-00000.mcap").write_bytes(b"nothing left")
        (path / "episodes.parquet").write_bytes(b"")
        repair_dataset(path)

    for moment in each_kill(damage_and_repair):
        path = tmp_path / f"{moment}" / "d"
        (path / "repairing/video").mkdir(parents=True, exist_ok=True)  # the real kill tidies nothing up
        repair_dataset(path)
        assert files_of(path) == files_of(tmp_path / "sound"), moment
        assert not (path / "repairing").exists()
        assert [one.name for one in path.parent.iterdir()] == ["d"]
