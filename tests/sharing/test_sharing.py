"""What is published is what a check needs, under its hashes; what is fetched is that, byte for byte."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from dmbench_command import dmbench
from sharing.conftest import Published
from sharing.workspaces import contents, entry_of, fingerprint, nothing_in, weights

import dmotion_bench as dm
from dmotion_bench.api.sharing import pull_entries
from dmotion_bench.errors import (
    DatasetMissing,
    DmbenchError,
    EntryInvalid,
    PackageNotInstalled,
    RunMissing,
    ShareMissing,
    UnknownName,
    UsageError,
)
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.sharing import run_share
from dmotion_bench.sharing.place import FolderPlace, plain_name
from dmotion_bench.sharing.run_share import RunShare
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import FileFacts
from dmotion_bench.workspace import Workspace

PUBLISHED = ("run.json", "best.safetensors", "metrics.jsonl", "report/report.json", "report/samples.parquet")


@pytest.mark.slow
def test_an_outsider_gets_the_same_bytes_from_every_kind_of_place(
    workspace: Workspace, outsider: Workspace, place: Published, tmp_path: Path
) -> None:
    pushed = dm.share_push(["known", workspace.data / "noise"], place.address)
    there = place.files()
    entry = entry_of(workspace, tmp_path / "entry.json")

    pulled = dm.share_pull(entry, place.address, workspace=outsider.root)

    assert [(one.kind, one.name, one.path) for one in pulled] == [
        ("data set", "noise", outsider.data / "noise"),
        ("run", "known", outsider.runs / "known"),
    ]
    assert contents(outsider.data / "noise") == contents(workspace.data / "noise")
    known = contents(workspace.runs / "known")
    assert contents(outsider.runs / "known") == {name: known[name] for name in PUBLISHED}
    assert sum(one.files for one in pushed) == len(there) == sum(one.sent for one in pushed)
    assert Dataset.open(outsider.data / "noise").labels(3).actions.tolist() is not None
    assert not list(outsider.root.rglob(".arriving"))


def test_a_folder_of_entries_stands_for_those_that_were_measured(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path
) -> None:
    (tmp_path / "entries").mkdir()
    entry_of(workspace, tmp_path / "entries" / "a.json")
    entry_of(workspace, tmp_path / "entries" / "b.json")
    entry_of(workspace, tmp_path / "entries" / "c.json", kind="published")
    pushed = dm.share_push(tmp_path / "entries", folder.address)
    assert [(one.kind, one.name) for one in pushed] == [("data set", "noise"), ("run", "known")]
    pulled = dm.share_pull([tmp_path / "entries"], folder.address, workspace=outsider.root)
    assert [one.path for one in pulled] == [outsider.data / "noise", outsider.runs / "known"]


def test_files_stand_under_their_hashes(workspace: Workspace, folder: Published) -> None:
    dm.share_push(["known", "noise"], folder.address)
    for name, content in folder.files().items():
        digest = hashlib.sha256(content).hexdigest()
        part = name.split("/")
        if part[0] == "runs":
            assert part[1] == weights(workspace)
            assert part[-1].removesuffix(".json") == digest
        else:
            assert part[:3] == ["datasets", fingerprint(workspace), "noise"]
    opened = Dataset.open(Path(folder.address) / "datasets" / fingerprint(workspace) / "noise")
    assert (opened.name, opened.fingerprint) == ("noise", fingerprint(workspace))


def test_a_run_is_published_without_labels_and_without_what_no_check_needs(
    workspace: Workspace, folder: Published
) -> None:
    dm.share_push("known", folder.address)
    published = {hashlib.sha256(content).hexdigest() for content in folder.files().values()}
    kept_back = [workspace.runs / "known" / "last.safetensors", *workspace.data.rglob("*.mcap")]
    assert not published & {hashlib.sha256(path.read_bytes()).hexdigest() for path in kept_back}


@pytest.mark.slow
def test_pushing_again_sends_what_is_missing_alone(workspace: Workspace, place: Published) -> None:
    dm.share_push(["known", "noise"], place.address)
    before = place.files()
    assert [one.sent for one in dm.share_push(["known", "noise"], place.address)] == [0, 0]
    lost = next(name for name in before if name.endswith("shard-00001.mcap") and "/video/" in name)
    place.delete(lost)
    again = dm.share_push(["known", "noise"], place.address)
    assert [one.sent for one in again] == [1, 0]
    assert place.files() == before


@pytest.mark.parametrize("what", ["known", "noise"])
def test_a_push_that_breaks_off_is_not_there_and_goes_on(
    workspace: Workspace, outsider: Workspace, folder: Published, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []
    write = FolderPlace.write

    def break_off(self: FolderPlace, file: Path, name: str) -> None:
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(name)
        write(self, file, name)

    with monkeypatch.context() as patch:
        patch.setattr(FolderPlace, "write", break_off)
        with pytest.raises(KeyboardInterrupt):
            dm.share_push(what, folder.address)
    assert dm.share_list(folder.address) == []
    hash_ = weights(workspace) if what == "known" else fingerprint(workspace)
    with pytest.raises(ShareMissing, match="dmbench share list"):
        dm.share_pull(hash_, folder.address, workspace=outsider.root)

    (again,) = dm.share_push(what, folder.address)

    assert again.sent == again.files - 3
    assert dm.share_pull(hash_, folder.address, workspace=outsider.root)[0].name == what


def test_another_report_of_the_same_weights_stands_beside_the_first(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path
) -> None:
    dm.share_push("known", folder.address)
    before = folder.files()
    first = entry_of(workspace, tmp_path / "first.json")
    (workspace.runs / "known/report/samples.parquet").write_bytes(b"scored again, with more")
    (pushed,) = dm.share_push("known", folder.address)
    assert pushed.sent == 2  # the samples and the manifest
    assert folder.files().items() >= before.items()

    dm.share_push("noise", folder.address)
    dm.share_pull(first, folder.address, workspace=outsider.root)
    assert (outsider.runs / "known/report/samples.parquet").read_bytes() == b"samples of its steps"

    elsewhere = tmp_path / "elsewhere"
    with pytest.raises(
        UsageError, match=r"several reports of these weights .* one of: [0-9a-f]{12}/[0-9a-f]{12} is known"
    ):
        dm.share_pull(weights(workspace), folder.address, workspace=elsewhere)
    newer = next(
        one.share for one in dm.share_list(folder.address) if one.share and f"{one.share}.json" not in str(before)
    )
    dm.share_pull(f"{weights(workspace)[:8]}/{newer[:8]}", folder.address, workspace=elsewhere)
    assert (elsewhere / "runs/known/report/samples.parquet").read_bytes() == b"scored again, with more"
    (workspace.runs / "known/report/samples.parquet").write_bytes(b"and never published")
    third = entry_of(workspace, tmp_path / "third.json")
    with pytest.raises(ShareMissing, match="no report with the samples"):
        dm.share_pull(third, folder.address, workspace=tmp_path / "nowhere")


@pytest.mark.slow
def test_labels_are_published_and_fetched_only_where_they_are_wanted(
    workspace: Workspace, outsider: Workspace, place: Published
) -> None:
    (pushed,) = dm.share_push("noise", place.address, labels=False)
    assert not pushed.labels
    assert not [name for name in place.files() if "/labels/" in name]
    (pulled,) = dm.share_pull(fingerprint(workspace)[:8], place.address, workspace=outsider.root)
    assert not pulled.labels
    assert not (outsider.data / "noise/labels").exists()

    (pushed,) = dm.share_push("noise", place.address)
    assert (pushed.labels, pushed.sent) == (True, 3)
    (pulled,) = dm.share_pull(fingerprint(workspace), place.address, workspace=outsider.root, labels=False)
    assert (pulled.labels, pulled.fetched) == (False, 0)
    (pulled,) = dm.share_pull(fingerprint(workspace), place.address, workspace=outsider.root)
    assert (pulled.labels, pulled.fetched) == (True, 3)
    assert contents(outsider.data / "noise") == contents(workspace.data / "noise")


def test_what_is_here_is_not_fetched_again_and_never_replaced(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    dm.share_push(["known", "noise"], folder.address)
    both = [weights(workspace), fingerprint(workspace)]
    dm.share_pull(both, folder.address, workspace=outsider.root)
    assert [one.fetched for one in dm.share_pull(both, folder.address, workspace=outsider.root)] == [0, 0]
    (outsider.runs / "known/metrics.jsonl").write_text("mine")
    with pytest.raises(UsageError, match=r"known' is there already, and its metrics.jsonl is not what is published"):
        dm.share_pull(both[0], folder.address, workspace=outsider.root)
    shard = outsider.data / "noise/video/shard-00000.mcap"
    shard.write_bytes(shard.read_bytes()[::-1])
    with pytest.raises(UsageError, match="is damaged; mend it with"):
        dm.share_pull(both[1], folder.address, workspace=outsider.root)
    shutil.rmtree(outsider.data / "noise")
    (outsider.data / "noise").mkdir()
    (outsider.data / "noise/dataset.json").write_text("{}")
    with pytest.raises(UsageError, match="is another data set"):
        dm.share_pull(both[1], folder.address, workspace=outsider.root)


@pytest.mark.parametrize("labels", [True, False])
def test_a_pull_that_breaks_off_goes_on(
    workspace: Workspace, outsider: Workspace, folder: Published, monkeypatch: pytest.MonkeyPatch, labels: bool
) -> None:
    dm.share_push("noise", folder.address)
    fetch, fetched = FolderPlace.fetch, list[str]()

    def break_off(self: FolderPlace, name: str, facts: FileFacts, to: Path) -> None:
        if len(fetched) == 4:
            raise KeyboardInterrupt
        fetched.append(name)
        fetch(self, name, facts, to)

    with monkeypatch.context() as patch:
        patch.setattr(FolderPlace, "fetch", break_off)
        with pytest.raises(KeyboardInterrupt):
            dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert nothing_in(outsider)
    (pulled,) = dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root, labels=labels)
    assert (outsider.data / "noise/labels").exists() == labels  # some had come already
    assert pulled.fetched == pulled.files - (4 if labels else 2)
    mine = {name: held for name, held in contents(workspace.data / "noise").items() if labels or "labels/" not in name}
    assert contents(outsider.data / "noise") == mine


@pytest.mark.parametrize(
    ("what", "error", "said"),
    [
        ("knwon", UnknownName, "did you mean 'known'"),
        ("published.json", UsageError, "neither weights nor data"),
        ("broken.json", EntryInvalid, "is no entry of the leaderboard: it.dataset is None"),
        ("hostile.json", EntryInvalid, "can be no folder's name"),
        ("away.json", RunMissing, "no run in .* has the weights 000000000000"),
        ("no_data.json", DatasetMissing, "no data set in .* has the fingerprint of 'noise'"),
    ],
)
def test_wrong_words_for_what_is_published(
    workspace: Workspace,
    folder: Published,
    what: str,
    error: type[DmbenchError],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    entry_of(workspace, tmp_path / "published.json", kind="published")
    entry_of(workspace, tmp_path / "broken.json", dataset=None)
    entry_of(workspace, tmp_path / "away.json", weights="0" * 64)
    entry_of(workspace, tmp_path / "no_data.json", dataset={"name": "noise", "fingerprint": "0" * 64})
    entry_of(workspace, tmp_path / "hostile.json", dataset={"name": "../x", "fingerprint": "0" * 64})
    with pytest.raises(error, match=said):
        dm.share_push(what, folder.address)


def test_wrong_words_for_places_and_hashes(workspace: Workspace, folder: Published, tmp_path: Path) -> None:
    dm.share_push(["known", "noise"], folder.address)
    with pytest.raises(UsageError, match=r"no place to share in; .* s3://, gs://, hf://"):
        dm.share_push("known", "ftp://host/place")
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a file and no place"):
        dm.share_list(tmp_path / "file")
    assert dm.share_list("C:/published") == []  # a folder of Windows, which is not there yet
    with pytest.raises(UsageError, match="no place to share in is named"):
        dm.share_push("known", "")
    with pytest.raises(UsageError, match="neither an entry's file nor a hash"):
        dm.share_pull("known", folder.address)
    some = dm.share_list(folder.address)[0].fingerprint[:16]
    for place, known in ((folder.address, some), (tmp_path / "nowhere", "none is known here")):
        with pytest.raises(UnknownName, match=f"no fingerprint named '00000000'; .*{known}.*dmbench share list"):
            dm.share_pull("00000000", place)
    assert dm.share_list(tmp_path / "nowhere") == []
    same = workspace.runs / "noise"
    shutil.copytree(workspace.runs / "known", same)
    with pytest.raises(UsageError, match="is a run and a data set"):
        dm.share_push("noise", folder.address)


def test_a_folder_of_published_results_alone_is_nothing_to_share(
    workspace: Workspace, folder: Published, tmp_path: Path
) -> None:
    entry_of(workspace, tmp_path / "published.json", kind="published")
    for share in (dm.share_push, dm.share_pull):
        with pytest.raises(UsageError, match="holds no result that was measured"):
            share(tmp_path, folder.address)


def test_what_hf_needs_is_named(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "huggingface_hub", None)
    with pytest.raises(PackageNotInstalled, match=r"huggingface_hub.*pip install 'dmbench\[hub\]'"):
        dm.share_list("hf://datasets/who/what")


@pytest.mark.parametrize(
    "name", ["..", ".", "", ".x", "a/b", "a\\b", "a\0", "x" * 300, "a\n", "C:", "a ", "~a", 3, None]
)
def test_names_that_can_be_no_folder(name: object) -> None:
    assert not plain_name(name)


def test_names_of_runs_and_data_sets_are_plain() -> None:
    assert all(map(plain_name, ["dmotion-robot_push-1500-small-epochs_10-s0", "cswm 10%", "gym-CartPole-v1", "Käse"]))


def test_a_manifest_is_read_as_it_is_written(workspace: Workspace) -> None:
    share = run_share.share_of(Run.open(workspace.runs / "known"))
    assert RunShare.parse(share.content()) == share
    assert sorted(share.files) == sorted(PUBLISHED)


def test_the_commands_say_what_was_done_and_what_to_type_next(
    workspace: Workspace,
    outsider: Workspace,
    folder: Published,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    entry = entry_of(workspace, tmp_path / "entry.json")

    def said(*words: str) -> str:
        return dmbench(["share", *words], capsys, monkeypatch).out

    assert said("list", folder.address).startswith("Nothing is published in ")
    told = said("push", str(entry), "--to", folder.address)
    assert "data set noise: 9 of 9 files sent" in told
    assert "run known: 6 of 6 files sent" in told
    fetch = f"dmbench share pull {fingerprint(workspace)[:16]} {weights(workspace)[:16]} --from {folder.address}"
    assert f"'{fetch}'" in told
    assert "run known: was there already" in said("push", "known", "--to", folder.address)
    listed = said("list", folder.address).splitlines()
    assert [line.split()[0] for line in listed] == ["data", "run"]
    assert "with labels" in listed[0]
    assert f"dmotion, 1 report, trained on {fingerprint(workspace)[:16]}" in listed[1]
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(outsider.root))
    assert f"dmbench share pull {fingerprint(workspace)[:16]}" in said(
        "pull", weights(workspace), "--from", folder.address
    )
    assert f"'dmbench leaderboard check {entry}'" in said("pull", str(entry), "--from", folder.address)
    found = json.loads(said("list", folder.address, "--json"))["shared"]
    assert [one["fingerprint"] for one in found] == [fingerprint(workspace), weights(workspace)]


def test_a_file_that_is_no_entry_keeps_no_other_from_being_fetched(
    workspace: Workspace, outsider: Workspace, folder: Published, tmp_path: Path
) -> None:
    """The check says of it that it does not hold; a leaderboard's whole folder may be named, too."""
    dm.share_push(["known", workspace.data / "noise"], folder.address)
    site = tmp_path / "site"
    (site / "entries").mkdir(parents=True)
    entry_of(workspace, site / "entries" / "known.json")
    (site / "entries" / "broken.json").write_text("{")
    (site / "schema.json").write_text("{}")

    missing = pull_entries([site], folder.address, workspace=outsider.root)

    assert missing == []
    assert (outsider.runs / "known" / "run.json").is_file()
