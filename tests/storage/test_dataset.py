"""Opening, splitting, caching: what a user of a data set relies on."""

from __future__ import annotations

import pickle
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from noise_world import assert_same_episode, noise_episode, noise_lengths, noise_spec, write_noise

from dmotion_bench.errors import (
    DatasetCorrupt,
    DatasetIncomplete,
    DatasetMissing,
    DatasetVersionUnknown,
    LabelsNotAvailable,
    UnknownName,
    UsageError,
)
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.split import split_episodes
from dmotion_bench.storage.writer import DatasetWriter

_OPENED: list[str] = []
_WATCHING = [False]


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and _WATCHING[0]:
        _OPENED.append(str(arguments[0]))


sys.addaudithook(_watch)


@pytest.fixture
def opened() -> Iterator[list[str]]:
    """Every file that is opened by Python meanwhile."""
    _OPENED.clear()
    _WATCHING[0] = True
    yield _OPENED
    _WATCHING[0] = False


def test_no_folder_and_no_manifest_are_missing(tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(DatasetMissing, match="dmbench record"):
            Dataset.open(path)


def test_an_interrupted_recording_names_the_command_that_goes_on(tmp_path: Path) -> None:
    recipe = DatasetRecipe(environment="grid_world", episodes=7, frames=8, tasks=3, seed=5)
    with DatasetWriter.create_or_resume(tmp_path / "d", recipe, noise_spec()):
        pass
    command = (
        f"dmbench record grid_world --episodes 7 --frames 8 --tasks 3 --seed 5 --set version=1 --out {tmp_path / 'd'}"
    )
    with pytest.raises(DatasetIncomplete, match=command):
        Dataset.open(tmp_path / "d")


def test_another_version_of_the_format_is_named(tmp_path: Path) -> None:
    manifest = write_noise(tmp_path / "d").path / "dataset.json"
    manifest.write_text(manifest.read_text().replace("dmbench/1", "dmbench/2"))
    with pytest.raises(DatasetVersionUnknown, match=r"'dmbench/2'.*'dmbench/1'"):
        Dataset.open(tmp_path / "d")


@pytest.mark.parametrize("table", ["episodes.parquet", "tasks.parquet"])
def test_a_changed_table_is_noticed(tmp_path: Path, table: str) -> None:
    file = write_noise(tmp_path / "d").path / table
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(DatasetCorrupt, match=f"{table}.*dmbench data repair"):
        Dataset.open(tmp_path / "d").tasks()


def test_a_missing_shard_is_noticed(tmp_path: Path) -> None:
    (write_noise(tmp_path / "d").path / "video" / "shard-00001.mcap").unlink()
    with pytest.raises(DatasetCorrupt, match=r"shard-00001.mcap' is damaged: it is missing"):
        Dataset.open(tmp_path / "d")


def test_an_episode_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    for number in (-1, 7):
        with pytest.raises(UsageError, match="it has 0 to 6"):
            dataset.video(number)
    with pytest.raises(UnknownName, match="did you mean 'train'"):
        dataset.split("trian")  # type: ignore[arg-type]


def test_without_labels_everything_but_the_labels_works_the_same(tmp_path: Path) -> None:
    write_noise(tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "apart")
    shutil.rmtree(tmp_path / "apart" / "labels")
    whole, apart = Dataset.open(tmp_path / "whole"), Dataset.open(tmp_path / "apart")
    assert whole.fingerprint == apart.fingerprint
    np.testing.assert_array_equal(whole.cache().frames, apart.cache().frames)
    np.testing.assert_array_equal(whole.split("test"), apart.split("test"))
    np.testing.assert_array_equal(whole.video(4), apart.video(4))
    assert whole.tasks() == apart.tasks()
    for read in (apart.labels, apart.states, apart.episode):
        with pytest.raises(LabelsNotAvailable, match="dmbench data repair"):
            read(4)


def test_video_cache_split_and_tasks_open_no_label_file(tmp_path: Path, opened: list[str]) -> None:
    path = write_noise(tmp_path / "d").path
    opened.clear()
    dataset = Dataset.open(path)
    for number in range(len(dataset)):
        dataset.video(number)
    assert len(dataset.cache().frames) > len(dataset.split("train"))
    assert dataset.tasks() == []
    assert any("video" in name for name in opened)
    assert not [name for name in opened if "labels" in name]
    dataset.states(0)
    assert [name for name in opened if "labels" in name]


def test_reading_an_episode_opens_one_file_once(tmp_path: Path, opened: list[str]) -> None:
    dataset = write_noise(tmp_path / "d")
    opened.clear()
    dataset.video(5)
    assert [Path(name).name for name in opened] == ["shard-00001.mcap"]


def test_a_data_set_travels_to_other_processes(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    copy: Dataset = pickle.loads(pickle.dumps(dataset))
    assert_same_episode(copy.episode(2), noise_episode(2, noise_lengths(7)[2], dataset.spec))


@settings(deadline=None, derandomize=True, max_examples=50)
@given(seed=st.integers(0, 2**63), episodes=st.integers(1, 400))
def test_every_episode_is_on_one_side(seed: int, episodes: int) -> None:
    split = split_episodes(seed, episodes)
    assert sorted(np.concatenate(list(split.values())).tolist()) == list(range(episodes))
    assert len(split["train"]) > 0
    if episodes >= 20:
        assert len(split["test"]) == round(0.1 * episodes)
        assert len(split["validation"]) == round(0.1 * (episodes - len(split["test"])))
    for name, members in split_episodes(seed, episodes).items():
        np.testing.assert_array_equal(members, split[name])


def test_most_episodes_stay_on_their_side_when_a_data_set_grows() -> None:
    small, large = split_episodes(3, 300), split_episodes(3, 600)
    stayed = np.intersect1d(small["test"], large["test"])
    assert len(stayed) > 0.6 * len(small["test"])  # by chance it would be a tenth
    assert len(np.intersect1d(split_episodes(4, 300)["test"], small["test"])) < 0.4 * 30
