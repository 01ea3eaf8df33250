"""Commands that are killed while they publish or fetch: the same command then ends as if nothing had been."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from killed_writes import Killed, killed_at
from sharing.conftest import Published
from sharing.workspaces import contents, fingerprint, weights

import dmotion_bench as dm
from dmotion_bench.errors import FolderInUse
from dmotion_bench.storage.lock import held
from dmotion_bench.workspace import Workspace


def killed(work: Callable[[], object], moment: int) -> None:
    with pytest.raises(Killed), killed_at(moment):
        work()


@pytest.mark.parametrize("moment", [0, 1, 7])
@pytest.mark.parametrize("name", ["known", "noise"])
def test_what_was_half_sent_goes_with_the_next_push(
    workspace: Workspace, folder: Published, tmp_path: Path, name: str, moment: int
) -> None:
    """A place is kept for long and used by many: halves of large files would stay for ever."""
    dm.share_push(name, tmp_path / "whole")
    killed(lambda: dm.share_push(name, folder.address), moment)
    assert list(Path(folder.address).rglob("*.part"))
    dm.share_push(name, folder.address)
    assert folder.files() == contents(tmp_path / "whole")


def test_labels_that_were_half_fetched_leave_nothing_in_the_data_set(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    dm.share_push("noise", folder.address)
    dm.share_pull(fingerprint(workspace), folder.address, labels=False, workspace=outsider.root)
    killed(lambda: dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root), 4)
    assert list(outsider.data.rglob("*.part"))
    (pulled,) = dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert pulled.labels
    assert contents(outsider.data / "noise") == contents(workspace.data / "noise")


def test_labels_are_not_fetched_while_another_command_writes_into_the_data_set(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    dm.share_push("noise", folder.address)
    dm.share_pull(fingerprint(workspace), folder.address, labels=False, workspace=outsider.root)
    with held(outsider.data / "noise"), pytest.raises(FolderInUse, match="another dmbench is writing into"):
        dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert not (outsider.data / "noise/labels").exists()


def test_what_an_earlier_try_left_appears_only_if_it_was_asked_for(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    """It may have come from another place: nothing but what the manifest lists is verified."""
    dm.share_push(["known", "noise"], folder.address)
    wanted = [fingerprint(workspace), weights(workspace)]
    for what, moment in zip(wanted, (10, 8), strict=True):
        killed(partial(dm.share_pull, what, folder.address, workspace=outsider.root), moment)
    for beside, extra in ((outsider.data, "labels/shard-00009.mcap"), (outsider.runs, "report/on/forged/report.json")):
        (arriving,) = (beside / ".arriving").glob("[!.]*")
        (arriving / extra).parent.mkdir(parents=True, exist_ok=True)
        (arriving / extra).write_text("{}")
        (arriving / "link").symlink_to(workspace.root)
    dm.share_pull(wanted, folder.address, labels=False, workspace=outsider.root)
    video = {name: one for name, one in contents(workspace.data / "noise").items() if not name.startswith("labels")}
    assert contents(outsider.data / "noise") == video
    assert not [one for one in outsider.runs.rglob("*") if "forged" in one.name or one.is_symlink()]
