"""Links in a data set's folder: one that leads out of it is refused by all that open it, others are followed."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from noise_world import assert_same_episode, files_of, write_noise

import dmotion_bench as dm
from dmotion_bench.errors import DatasetError
from dmotion_bench.recording.restore import repair_dataset
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.links import require_no_link_out
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.summary import summarize

OUT = r"is a link that leads out of the data set's folder, to '.*/elsewhere/.*put what it leads to in its place"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Not to be changed."""
    return write_noise(tmp_path_factory.mktemp("links") / "noise")


@pytest.fixture
def noise(made: Dataset, tmp_path: Path) -> Path:
    """A copy to spoil."""
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(made.path, tmp_path / "data/noise")
    return tmp_path / "data/noise"


def move_out(path: Path, elsewhere: Path) -> None:
    """Put a link in the place of a file or folder."""
    if path.exists():
        path.rename(elsewhere / path.name)
    path.symlink_to(elsewhere / path.name)


@pytest.mark.parametrize(
    "name",
    [
        *("dataset.json", "episodes.parquet", "tasks.parquet", "video", "labels", "cache"),
        *("video/shard-00001.mcap", "labels/shard-00000.mcap", "video/shard-00000.mcap.01234567.part"),
    ],
)
def test_what_leads_out_is_read_by_nobody(noise: Path, made: Dataset, tmp_path: Path, name: str) -> None:
    """Not even if it is what it should be: it may be another user's, whose file only its reader can read."""
    move_out(noise / name, tmp_path / "elsewhere")
    before = sorted(tmp_path.rglob("*"))
    for read in (Dataset.open, Manifest.read, check_dataset, summarize, repair_dataset):
        with pytest.raises(DatasetError, match=rf"{name}' {OUT}"):
            read(noise)
    for use in (
        lambda: dm.share_push(noise, tmp_path / "place"),
        lambda: dm.view(noise, save=tmp_path / "noise.rrd"),
        lambda: dm.export_dataset(noise, out=tmp_path / "exported"),
    ):
        with pytest.raises(DatasetError, match=OUT):
            use()
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_that_is_a_link_and_links_within_it_are_followed(noise: Path, made: Dataset, tmp_path: Path) -> None:
    (noise / "video").rename(noise / "kept")
    (noise / "video").symlink_to("kept")
    (noise / "labels/shard-00000.mcap").rename(noise / ".kept")
    (noise / "labels/shard-00000.mcap").symlink_to("../.kept")
    (noise / "all").symlink_to(".")
    noise.rename(tmp_path / "elsewhere/noise")
    noise.symlink_to(tmp_path / "elsewhere/noise")
    for path in (noise, noise / "all", tmp_path / "elsewhere/noise"):
        opened = Dataset.open(path)
        assert_same_episode(opened.episode(0), made.episode(0))
    assert not check_dataset(noise).damages
    dm.share_push(noise, tmp_path / "place")
    dm.share_pull(made.fingerprint, tmp_path / "place", workspace=tmp_path / "fetched")
    assert files_of(tmp_path / "fetched/data/noise") == files_of(made.path)


def test_no_way_around_leads_out(noise: Path, tmp_path: Path) -> None:
    """By way of a hidden folder, of which nothing is looked at otherwise."""
    (noise / "video").rename(noise / ".kept")
    (noise / "video").symlink_to(".kept")
    (noise / ".other").symlink_to(tmp_path)
    Dataset.open(noise)
    move_out(noise / ".kept/shard-00001.mcap", tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=rf"\.kept/shard-00001.mcap' {OUT}"):
        Dataset.open(noise)


def test_a_link_to_itself_leads_nowhere(noise: Path) -> None:
    (noise / "notes").symlink_to("notes")
    Dataset.open(noise)


def test_a_folder_that_hides_its_links_is_refused(noise: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = os.scandir

    def hiding_video(place: Path) -> Any:
        if Path(place).name == "video":  # as for anybody but root where it may be entered and not listed
            raise PermissionError(errno.EACCES, "Permission denied", str(place))
        return listed(place)

    monkeypatch.setattr(os, "scandir", hiding_video)
    with pytest.raises(PermissionError):
        Dataset.open(noise)


def test_what_is_no_data_set_is_not_searched(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("/")
    require_no_link_out(tmp_path / "dataset.json", "data set", DatasetError)
