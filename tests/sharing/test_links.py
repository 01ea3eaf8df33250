"""Links in a place, in a workspace and in what is published lead nowhere else."""

from __future__ import annotations

from pathlib import Path

import pytest
from sharing.conftest import Published
from sharing.workspaces import contents, fingerprint, nothing_in, weights

import dmotion_bench as dm
from dmotion_bench.errors import DmbenchError, RunError, ShareCorrupt, ShareMissing, UsageError
from dmotion_bench.scoring.transfer import transfer_folders
from dmotion_bench.sharing.place import open_place
from dmotion_bench.workspace import Workspace


@pytest.mark.parametrize("part", ["/files/", "dataset.json", "video/shard-00000.mcap"])
def test_links_in_a_place_are_not_followed(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path, part: str
) -> None:
    dm.share_push(["known", "noise"], folder.address)
    path = next(Path(folder.address) / name for name in folder.files() if part in name)
    path.rename(tmp_path / "secret")
    path.symlink_to(tmp_path / "secret")
    with pytest.raises((ShareCorrupt, ShareMissing)):
        dm.share_pull([weights(workspace), fingerprint(workspace)], folder.address, workspace=outsider.root)
    assert not (outsider.data / "noise").exists() or not (outsider.runs / "known").exists()


@pytest.mark.parametrize("depth", range(4))
def test_folders_that_are_links_are_not_written_through(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path, depth: int
) -> None:
    """Somebody else who may write to a shared folder could have another's files replaced."""
    dm.share_push("noise", folder.address)
    path = next(Path(folder.address).rglob("video"))
    path = [path, *path.parents][depth]
    path.rename(tmp_path / "mine")
    path.symlink_to(tmp_path / "mine")
    for shard in (tmp_path / "mine").rglob("shard-00000.mcap"):
        shard.write_bytes(b"of another length")
    before = contents(tmp_path / "mine")
    for mend in (False, True):
        with pytest.raises(ShareCorrupt, match="is a link, and links in a place are not followed; delete it"):
            dm.share_push("noise", folder.address, mend=mend)
    with pytest.raises(DmbenchError, match=r"is a link|has no data set with|no fingerprint named"):
        dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert contents(tmp_path / "mine") == before
    assert nothing_in(outsider)
    path.unlink()
    dm.share_push("noise", folder.address)
    assert dm.share_list(folder.address)[0].labels


def test_links_in_the_workspace_are_not_written_through(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path
) -> None:
    dm.share_push(["known", "noise"], folder.address)
    for path, wanted in ((outsider.runs / "known", weights), (outsider.data / "noise", fingerprint)):
        path.parent.mkdir()
        path.symlink_to(tmp_path / "anywhere")
        with pytest.raises(UsageError, match="is there already"):
            dm.share_pull(wanted(workspace), folder.address, workspace=outsider.root)
        path.unlink()
    (outsider.runs / ".arriving").symlink_to(tmp_path)
    with pytest.raises(UsageError, match="is a link; delete it"):
        dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)
    assert not (tmp_path / "anywhere").exists()


@pytest.mark.parametrize("name", ["metrics.jsonl", "best.safetensors", "report"])
def test_what_a_link_in_a_run_leads_to_is_not_published(
    workspace: Workspace, folder: Published, tmp_path: Path, name: str
) -> None:
    """A run may come from somebody else, and name a file that only its reader can read."""
    path = workspace.runs / "known" / name
    path.rename(tmp_path / "secret")
    path.symlink_to(tmp_path / "secret")
    with pytest.raises(RunError, match=rf"{name}.* is a link that leads out of the run's folder"):
        dm.share_push("known", folder.address)
    assert folder.files() == {}


def test_a_hidden_folder_beside_the_reports_is_not_looked_into(
    workspace: Workspace, folder: Published, tmp_path: Path
) -> None:
    """Other programs keep links in such folders, which may lead anywhere."""
    report = workspace.runs / "known" / "report"
    hidden = report / "on" / ".hidden"
    hidden.mkdir(parents=True)
    for name in ("report.json", "samples.parquet"):
        (tmp_path / name).write_text("private")
        (hidden / name).symlink_to(tmp_path / name)
    dm.share_push("known", folder.address)
    assert not [name for name, content in folder.files().items() if content == b"private"]
    assert transfer_folders(workspace.runs / "known") == []


def test_labels_are_not_fetched_into_a_folder_that_leads_elsewhere(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path
) -> None:
    dm.share_push("noise", folder.address)
    dm.share_pull(fingerprint(workspace), folder.address, labels=False, workspace=outsider.root)
    (tmp_path / "elsewhere").mkdir()
    (outsider.data / "noise/labels").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match=r"is there already, and cannot be opened: .*labels' is a link that leads out"):
        dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_run_whose_folder_is_a_link_is_published(workspace: Workspace, folder: Published, tmp_path: Path) -> None:
    """Its owner put it on another disk."""
    (workspace.runs / "known").rename(tmp_path / "known")
    (workspace.runs / "known").symlink_to(tmp_path / "known")
    dm.share_push("known", folder.address)
    assert len(folder.files()) > 2


@pytest.mark.parametrize("place", ["in_the_way/below", "whole"])
def test_a_file_in_a_folders_way_is_said(tmp_path: Path, place: str) -> None:
    for name in ("in_the_way", "whole/datasets", "sent"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("here before")
    with pytest.raises(UsageError, match=r"datasets/ab' cannot be a folder, a file is in the way; delete that file"):
        open_place(tmp_path / place).write(tmp_path / "sent", "datasets/ab/one")
    assert {file.read_text() for file in tmp_path.rglob("*") if file.is_file()} == {"here before"}
