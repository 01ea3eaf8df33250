"""What is published is what a check needs, under its hashes; what is fetched is that, byte for byte, or nothing."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import dmbench
from object_storage import Storage
from sharing.conftest import Published

import dmotion_bench as dm
from dmotion_bench.errors import (
    DatasetCorrupt,
    DatasetMissing,
    DmbenchError,
    EntryInvalid,
    PackageNotInstalled,
    PlaceUnreachable,
    RunCorrupt,
    RunMissing,
    ShareCorrupt,
    ShareMissing,
    StorageFull,
    UnknownName,
    UsageError,
)
from dmotion_bench.learning.run import Run
from dmotion_bench.sharing import run_share
from dmotion_bench.sharing.place import FolderPlace, plain_name
from dmotion_bench.sharing.run_share import RunShare
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import FileFacts
from dmotion_bench.workspace import Workspace

PUBLISHED = ("run.json", "best.safetensors", "metrics.jsonl", "report/report.json", "report/samples.parquet")


def weights(workspace: Workspace) -> str:
    return str((Run.open(workspace.runs / "known").result or {})["weights"])


def fingerprint(workspace: Workspace) -> str:
    return Dataset.open(workspace.data / "noise").fingerprint


def contents(folder: Path) -> dict[str, bytes]:
    return {one.relative_to(folder).as_posix(): one.read_bytes() for one in folder.rglob("*") if one.is_file()}


def nothing_in(workspace: Workspace) -> bool:
    """Whether no run and no data set has appeared, nor a file that is not what it should be."""
    there = [one.name for folder in (workspace.runs, workspace.data) for one in folder.glob("*")]
    return set(there) <= {".arriving"} and not workspace.all_runs() and not workspace.datasets()


def entry_of(workspace: Workspace, path: Path, **changes: Any) -> Path:
    samples = (workspace.runs / "known" / "report" / "samples.parquet").read_bytes()
    content = {
        "kind": "measured",
        "weights": weights(workspace),
        "samples": {"sha256": hashlib.sha256(samples).hexdigest()},
        "dataset": {"name": "noise", "fingerprint": fingerprint(workspace)},
    }
    path.write_text(json.dumps(content | changes))
    return path


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


def test_a_pull_that_breaks_off_goes_on(
    workspace: Workspace, outsider: Workspace, folder: Published, monkeypatch: pytest.MonkeyPatch
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
    (pulled,) = dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert pulled.fetched == pulled.files - 4
    assert contents(outsider.data / "noise") == contents(workspace.data / "noise")


class Faults:
    """Spoils the first few answers to a method, for paths with a part."""

    def __init__(self, kind: str, times: int, method: str, part: str) -> None:
        self.kind, self.left, self.method, self.part = kind, times, method, part

    def __call__(self, method: str, path: str) -> str | None:
        if method != self.method or self.part not in path.partition("?")[0] or not self.left:
            return None
        self.left -= 1
        return self.kind


@pytest.mark.parametrize("kind", ["500", "503", "truncated", "short", "wrong"])
def test_what_fails_for_a_while_is_asked_for_again(
    workspace: Workspace, outsider: Workspace, storage: Storage, bucket: Published, kind: str
) -> None:
    if kind in ("500", "503"):
        storage.fault = Faults(kind, 2, "PUT", "/files/")
    dm.share_push(["known", "noise"], bucket.address)
    for part, wanted in (("/files/", weights), (".mcap", fingerprint)):
        storage.fault = faults = Faults(kind, 2, "GET", part)
        dm.share_pull(wanted(workspace), bucket.address, workspace=outsider.root)
        assert not faults.left
    assert contents(outsider.data / "noise") == contents(workspace.data / "noise")


@pytest.mark.parametrize("kind", ["500", "503", "truncated", "short", "wrong"])
def test_what_fails_for_good_costs_a_sentence_and_leaves_nothing_wrong(
    workspace: Workspace, outsider: Workspace, storage: Storage, bucket: Published, kind: str
) -> None:
    dm.share_push(["known", "noise"], bucket.address)
    error = ShareCorrupt if kind in ("short", "wrong") else PlaceUnreachable
    for part, wanted in (("/files/", weights), (".mcap", fingerprint)):
        storage.fault = Faults(kind, 1000, "GET", part)
        with pytest.raises(error, match=r"is damaged: .* Nothing of it is used|failed 4 times"):
            dm.share_pull(wanted(workspace), bucket.address, workspace=outsider.root)
        assert nothing_in(outsider)
    storage.fault = lambda _method, _path: None
    assert set(contents(outsider.root).values()) <= set(bucket.files().values())  # what has arrived is right
    dm.share_pull([weights(workspace), fingerprint(workspace)], bucket.address, workspace=outsider.root)
    assert contents(outsider.data / "noise") == contents(workspace.data / "noise")


def test_a_bucket_that_is_not_there_or_closed_is_said(workspace: Workspace, storage: Storage) -> None:
    with pytest.raises(PlaceUnreachable, match="there is no such bucket or repository; make it first"):
        dm.share_push("known", "s3://nobody-has-this/place")
    storage.fault = Faults("503", 1000, "PUT", "")
    with pytest.raises(PlaceUnreachable, match="failed 4 times"):
        dm.share_push("known", storage.address)


def test_damage_in_a_place_is_never_passed_on_and_can_be_mended(
    workspace: Workspace, outsider: Workspace, place: Published
) -> None:
    dm.share_push(["known", "noise"], place.address)
    before = place.files()
    largest = max((name for name in before if "/files/" in name), key=lambda name: len(before[name]))
    shard = next(name for name in before if name.endswith("video/shard-00002.mcap"))
    table = next(name for name in before if name.endswith("tasks.parquet"))
    for name in (largest, shard, table):
        content = bytearray(before[name])
        content[len(content) // 2] ^= 1
        place.put(name, bytes(content))
        wanted = weights(workspace) if name == largest else fingerprint(workspace)
        with pytest.raises(ShareCorrupt, match=r"damaged: .* Nothing of it is used\. .*--mend"):
            dm.share_pull(wanted, place.address, workspace=outsider.root)
        assert nothing_in(outsider)
        dm.share_push(["known", "noise"], place.address)  # a file of the right size is believed
        assert place.files()[name] != before[name]
        dm.share_push(["known", "noise"], place.address, mend=True)
        assert place.files() == before


def test_a_dataset_json_that_is_another_is_refused_by_who_pushes_and_who_pulls(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    dm.share_push("noise", folder.address)
    name = next(name for name in folder.files() if name.endswith("dataset.json"))
    sound = folder.files()[name]
    forged = json.loads(sound)
    forged["recipe"]["seed"] += 1
    for content, said in ((json.dumps(forged).encode(), "has the fingerprint"), (b"{", "cannot be used")):
        folder.put(name, content)
        with pytest.raises(ShareCorrupt, match=said):
            dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
        with pytest.raises(ShareCorrupt, match="Nothing was replaced"):
            dm.share_push("noise", folder.address)
        assert folder.files()[name] == content
        assert [one.damage != "" for one in dm.share_list(folder.address)] == [True]
    dm.share_push("noise", folder.address, mend=True)
    assert folder.files()[name] == sound


def test_tables_that_no_fingerprint_tells_are_held_against_the_shards(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    """Whoever stores a data set could list other episodes, with the right hash of the wrong table."""
    dm.share_push("noise", folder.address)
    root = f"datasets/{fingerprint(workspace)}/noise"
    import pyarrow.parquet as pq

    table = Path(folder.address) / root / "episodes.parquet"
    rows = pq.read_table(table)
    seeds = [seed + 1 for seed in rows["seed"].to_pylist()]
    pq.write_table(rows.set_column(rows.schema.get_field_index("seed"), rows.schema.field("seed"), [seeds]), table)
    manifest = json.loads(folder.files()[f"{root}/dataset.json"])
    content = table.read_bytes()
    manifest["tables"]["episodes.parquet"] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    folder.put(f"{root}/dataset.json", json.dumps(manifest).encode())
    with pytest.raises(ShareCorrupt, match=r"is not what its name says: .*episode"):
        dm.share_pull(fingerprint(workspace), folder.address, workspace=outsider.root)
    assert contents(outsider.root) == {}


def hostile(changes: dict[str, Any], **files: Any) -> Any:
    return lambda share: share | changes | {"files": share["files"] | files}


FACTS = {"size": 3, "sha256": hashlib.sha256(b"bad").hexdigest()}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (hostile({}, **{"../../.bashrc": FACTS}), r"'../../.bashrc', which no run has"),
        (hostile({}, **{"/etc/passwd": FACTS}), "'/etc/passwd', which no run has"),
        (hostile({}, **{"report/on/../report.json": FACTS}), "which no run has"),
        (hostile({}, **{"report/on/a/b/report.json": FACTS}), "which no run has"),
        (hostile({}, **{"report\\..\\x": FACTS}), "which no run has"),
        (hostile({}, **{"model.pt": FACTS}), "'model.pt', which no run has"),
        (hostile({}, **{"metrics.jsonl": FACTS | {"size": 2**40}}), "at most 1,073,741,824 can be"),
        (hostile({}, **{"metrics.jsonl": FACTS | {"size": -1}}), "has -1 bytes"),
        (hostile({}, **{"metrics.jsonl": FACTS | {"size": True}}), "size is True"),
        (hostile({}, **{"metrics.jsonl": FACTS | {"sha256": "../../x"}}), "is the SHA-256 of"),
        (hostile({}, **{f"report/on/{number}/report.json": FACTS for number in range(300)}), "at most 200"),
        (hostile({"run": "../known"}), "can be no folder's name"),
        (hostile({"run": ".ssh"}), "can be no folder's name"),
        (hostile({"run": ""}), "can be no folder's name"),
        (hostile({"run": 3}), "run is 3"),
        (hostile({"weights": "0" * 64}), "is of the weights 000000000000"),
        (hostile({"format": "dmbench-share/9"}), "this dmbench reads 'dmbench-share/1'"),
        (lambda share: share | {"files": {}}, "lists no run.json"),
        (lambda share: [share], "not a JSON object"),
    ],
)
def test_a_hostile_manifest_is_refused_before_anything_is_fetched(
    workspace: Workspace, outsider: Workspace, folder: Published, change: Any, said: str
) -> None:
    dm.share_push("known", folder.address)
    name, content = next((name, content) for name, content in folder.files().items() if name.endswith(".json"))
    folder.delete(name)
    forged = json.dumps(change(json.loads(content))).encode()
    folder.put(f"{name.rpartition('/')[0]}/{hashlib.sha256(forged).hexdigest()}.json", forged)
    with pytest.raises(ShareCorrupt, match=said):
        dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)
    assert list(outsider.root.iterdir()) == []
    assert [one.damage != "" for one in dm.share_list(folder.address)] == [True]


def test_a_manifest_under_another_name_than_its_hash_is_refused(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    dm.share_push("known", folder.address)
    name, content = next((name, content) for name, content in folder.files().items() if name.endswith(".json"))
    folder.put(name, content.replace(b'"model": "dmotion"', b'"model": "another"'))
    with pytest.raises(ShareCorrupt, match="does not hold the bytes that its name"):
        dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)


def test_other_weights_with_a_manifest_that_lies_are_deleted_again(
    workspace: Workspace, outsider: Workspace, folder: Published
) -> None:
    """Every hash of the manifest is right, and the weights are still not those of the name."""
    dm.share_push("known", folder.address)
    content = next(content for name, content in folder.files().items() if name.endswith(".json"))
    share = json.loads(content)
    run = json.loads((workspace.runs / "known/run.json").read_text())
    run["result"]["weights"] = share["weights"] = "1" * 64
    forged = json.dumps(run).encode()
    digest = hashlib.sha256(forged).hexdigest()
    share["files"]["run.json"] = {"size": len(forged), "sha256": digest}
    for old, file in list(folder.files().items()):
        if "/files/" in old:
            folder.put(f"runs/{'1' * 64}/files/{old.rpartition('/')[2]}", file)
    folder.put(f"runs/{'1' * 64}/files/{digest}", forged)
    manifest = json.dumps(share).encode()
    folder.put(f"runs/{'1' * 64}/{hashlib.sha256(manifest).hexdigest()}.json", manifest)
    with pytest.raises(ShareCorrupt, match=r"is not what its name says: .*other weights"):
        dm.share_pull("1" * 64, folder.address, workspace=outsider.root)
    assert contents(outsider.root) == {}


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


def test_what_does_not_fit_is_not_begun(
    workspace: Workspace, outsider: Workspace, folder: Published, monkeypatch: pytest.MonkeyPatch
) -> None:
    dm.share_push("known", folder.address)
    monkeypatch.setattr("shutil.disk_usage", lambda _path: shutil._ntuple_diskusage(10, 9, 1))  # type: ignore[attr-defined]
    with pytest.raises(StorageFull, match="are to be fetched"):
        dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)


def test_nothing_damaged_is_published(workspace: Workspace, folder: Published) -> None:
    shard = workspace.data / "noise/video/shard-00001.mcap"
    shard.write_bytes(bytes(len(shard.read_bytes())))
    with pytest.raises(DatasetCorrupt, match="is not what was recorded, so it is not published"):
        dm.share_push("noise", folder.address)
    best = workspace.runs / "known/best.safetensors"
    best.write_bytes(best.read_bytes()[:-1] + b"\0")
    with pytest.raises(RunCorrupt):
        dm.share_push("known", folder.address)
    (workspace.runs / "known/run.json").write_text(
        json.dumps(json.loads((workspace.runs / "known/run.json").read_text()) | {"result": None})
    )
    with pytest.raises(RunMissing, match="not trained to its end"):
        dm.share_push("known", folder.address)
    assert dm.share_list(folder.address) == []


def test_a_run_that_changes_while_it_is_published_leaves_nothing(
    workspace: Workspace, folder: Published, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = FolderPlace.write

    def change(self: FolderPlace, file: Path, name: str) -> None:
        (workspace.runs / "known/metrics.jsonl").write_text("another row")
        write(self, file, name)

    monkeypatch.setattr(FolderPlace, "write", change)
    with pytest.raises(DmbenchError, match="changed while it was published"):
        dm.share_push("known", folder.address)
    assert folder.files() == {}


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
    with pytest.raises(UsageError, match="neither an entry's file nor a hash"):
        dm.share_pull("known", folder.address)
    with pytest.raises(UnknownName, match="no fingerprint named '00000000'"):
        dm.share_pull("00000000", folder.address)
    assert dm.share_list(tmp_path / "nowhere") == []
    same = workspace.runs / "noise"
    shutil.copytree(workspace.runs / "known", same)
    with pytest.raises(UsageError, match="is a run and a data set"):
        dm.share_push("noise", folder.address)


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


@pytest.fixture(autouse=True)
def _no_leftovers(tmp_path: Path) -> Iterator[None]:
    yield
    assert not list(tmp_path.rglob("*.part"))
