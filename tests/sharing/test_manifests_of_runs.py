"""The manifests of one run: what is published can be fetched, and the one that is meant is found among several."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from sharing.conftest import Published
from sharing.workspaces import contents, entry_of, weights

import dmotion_bench as dm
from dmotion_bench.errors import ShareMissing, UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.sharing.pull import MOST_SHARES
from dmotion_bench.sharing.run_share import share_of
from dmotion_bench.workspace import Workspace


def _score_elsewhere(workspace: Workspace, name: str, samples: bytes) -> None:
    """Another report of the run, on another data set."""
    folder = workspace.runs / "known" / "report" / "on" / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").write_text("{}")
    (folder / "samples.parquet").write_bytes(samples)


@pytest.mark.parametrize("is_first", [True, False])
def test_entries_of_earlier_and_later_reports_are_fetched_one_after_the_other(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path, is_first: bool
) -> None:
    """Both manifests hold the earlier report; whichever name comes first, the later entry needs the later one."""
    dm.share_push(["known", "noise"], folder.address)
    run = Run.open(workspace.runs / "known")
    before = share_of(run).digest
    earlier = entry_of(workspace, tmp_path / "earlier.json")
    for number in range(100):
        _score_elsewhere(workspace, "another", b"samples of another data set, number %d" % number)
        if (before < share_of(run).digest) is is_first:
            break
    dm.share_push("known", folder.address)
    own = workspace.runs / "known" / "report" / "samples.parquet"
    kept = own.read_bytes()
    own.write_bytes((own.parent / "on" / "another" / "samples.parquet").read_bytes())
    later = entry_of(workspace, tmp_path / "later.json")
    own.write_bytes(kept)

    dm.share_pull([earlier, later], folder.address, workspace=outsider.root)

    assert contents(outsider.runs / "known" / "report") == contents(workspace.runs / "known" / "report")


def test_an_earlier_state_of_a_run_that_is_here_is_enough_for_its_own_entry(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path
) -> None:
    dm.share_push(["known", "noise"], folder.address)
    entry = entry_of(workspace, tmp_path / "entry.json")
    dm.share_pull(entry, folder.address, workspace=outsider.root)
    _score_elsewhere(workspace, "another", b"samples of another data set")
    dm.share_push("known", folder.address)
    before = contents(outsider.root)
    assert [one.fetched for one in dm.share_pull(entry, folder.address, workspace=outsider.root)] == [0, 0]
    assert contents(outsider.root) == before


def test_what_nobody_could_fetch_is_not_published(workspace: Workspace, folder: Published) -> None:
    for number in range(100):
        _score_elsewhere(workspace, f"data-{number}", b"samples")
    with pytest.raises(UsageError, match=r"'known' cannot be published, .*lists 205 files, and a run has at most 200"):
        dm.share_push("known", folder.address)
    assert folder.files() == {}


def test_a_run_of_many_actions_with_long_names_is_published_and_fetched(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    file = workspace.runs / "known" / "run.json"
    content = json.loads(file.read_text())
    content["spec"]["actions"] = 4096
    content["action_names"] = [f"{number:04d}".ljust(256, "n") for number in range(4096)]
    file.write_text(json.dumps(content, indent=2))
    assert Run.open(file.parent).result is not None
    dm.share_push("known", folder.address)
    dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)
    assert (outsider.runs / "known" / "run.json").read_bytes() == file.read_bytes()


def test_a_manifest_that_is_not_there_is_said_beside_those_that_are(workspace: Workspace, folder: Published) -> None:
    dm.share_push("known", folder.address)
    (share,) = (one.share for one in dm.share_list(folder.address))
    with pytest.raises(ShareMissing, match=rf"has no manifest that begins with 00000000; it has .*/{share[:12]}\."):
        dm.share_pull(f"{weights(workspace)}/00000000", folder.address)


def test_a_manifest_that_is_named_is_found_among_any_number(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    """Anybody who may write there can put more manifests beside it than are looked at."""
    dm.share_push("known", folder.address)
    (share,) = (one.share for one in dm.share_list(folder.address))
    for number in range(MOST_SHARES):
        folder.put(f"runs/{weights(workspace)}/{'0' * 60}{number:04d}.json", b"{}")
    dm.share_pull(f"{weights(workspace)}/{share[:12]}", folder.address, workspace=outsider.root)
    assert (outsider.runs / "known" / "run.json").is_file()


def test_what_is_no_file_of_samples_keeps_no_entry_from_being_published(
    workspace: Workspace, folder: Published, tmp_path: Path
) -> None:
    entry = entry_of(workspace, tmp_path / "entry.json")
    (workspace.runs / "known" / "report" / "on" / "another" / "samples.parquet").mkdir(parents=True)
    shutil.copytree(workspace.runs / "known", workspace.runs / "a-copy")
    (workspace.runs / "a-copy" / "report" / "samples.parquet").unlink()
    assert [one.name for one in dm.share_push(entry, folder.address)] == ["noise", "known"]
