"""Places that fail, lie or are damaged, and workspaces that are: what is fetched is right, or nothing is."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from object_storage import Storage
from sharing.conftest import Published
from sharing.workspaces import Faults, contents, fingerprint, nothing_in, weights

import dmotion_bench as dm
from dmotion_bench.errors import (
    DatasetCorrupt,
    FolderInUse,
    PlaceUnreachable,
    RunCorrupt,
    RunMissing,
    ShareCorrupt,
    StorageFull,
)
from dmotion_bench.sharing.place import FolderPlace
from dmotion_bench.workspace import Workspace


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
    unreadable = f"cannot be used: '{folder.address}/{name}' cannot be read"
    for content, said in ((json.dumps(forged).encode(), "has the fingerprint"), (b"{", unreadable)):
        folder.put(name, content)
        with pytest.raises(ShareCorrupt, match=re.escape(said)):
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
        (hostile({}, **{"report/on/a/generic/generic/report.json": FACTS}), "which no run has"),
        (hostile({}, **{"report/on/../generic/report.json": FACTS}), "which no run has"),
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
    with pytest.raises(ShareCorrupt, match=r"\.json' is damaged: it does not hold the bytes that its name .*--mend"):
        dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)
    assert ["does not hold the bytes" in one.damage for one in dm.share_list(folder.address)] == [True]


@pytest.mark.parametrize("digest", ["0" * 64, "f" * 64])
def test_a_damaged_manifest_spoils_no_other(
    workspace: Workspace, outsider: Workspace, folder: Published, digest: str
) -> None:
    """Anybody who may write there may have left it; others still see and fetch what is sound."""
    dm.share_push(["known", "noise"], folder.address)
    folder.put(f"runs/{weights(workspace)}/{digest}.json", b"{}")
    listed = dm.share_list(folder.address)
    assert sorted((one.kind, one.damage != "") for one in listed) == [
        ("data set", False),
        ("run", False),
        ("run", True),
    ]
    dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)
    assert (outsider.runs / "known").is_dir()


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


def test_what_does_not_fit_is_not_begun(
    workspace: Workspace, outsider: Workspace, folder: Published, monkeypatch: pytest.MonkeyPatch
) -> None:
    dm.share_push("known", folder.address)
    monkeypatch.setattr("shutil.disk_usage", lambda _path: shutil._ntuple_diskusage(10, 9, 1))  # type: ignore[attr-defined]
    with pytest.raises(StorageFull, match="are to be fetched"):
        dm.share_pull(weights(workspace), folder.address, workspace=outsider.root)


def test_nothing_damaged_is_published(workspace: Workspace, made: Workspace, folder: Published) -> None:
    shard = workspace.data / "noise/video/shard-00001.mcap"
    shard.write_bytes(bytes(len(shard.read_bytes())))
    with pytest.raises(DatasetCorrupt, match="is not what was recorded, so it is not published"):
        dm.share_push("noise", folder.address)
    shard.unlink()
    shutil.copyfile(made.data / "noise/video/shard-00001.mcap", shard)
    (workspace.data / "noise/labels/shard-00001.mcap").unlink()  # with one missing, the others are not passed over
    with pytest.raises(DatasetCorrupt, match=r"labels/shard-00001.mcap' is not what was recorded"):
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
    with pytest.raises(FolderInUse, match="changed while it was published"):
        dm.share_push("known", folder.address)
    assert not any("metrics" in name or name.endswith(".json") for name in folder.files())
    assert dm.share_list(folder.address) == []


@pytest.mark.parametrize("name", ["video/shard-00002.mcap", "labels/shard-00002.mcap", "tasks.parquet", "dataset.json"])
def test_a_data_set_that_changes_while_it_is_published_is_not(
    workspace: Workspace, folder: Published, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """As by a recording of more episodes: the last shard grows, and ``dataset.json`` says at first that it is begun."""
    write, other = FolderPlace.write, workspace.data / "noise" / name

    def change(self: FolderPlace, file: Path, to: str) -> None:
        if name == "dataset.json" or file == other:
            content = other.read_bytes()
            other.write_bytes(
                content.replace(b'"complete": true', b'"complete": false') if b"{" in content[:1] else b""
            )
        write(self, file, to)

    monkeypatch.setattr(FolderPlace, "write", change)
    with pytest.raises(FolderInUse, match=rf"{name}' changed while it was published"):
        dm.share_push("noise", folder.address)
    assert dm.share_list(folder.address) == []
    assert not any(one.endswith((name, "dataset.json")) for one in folder.files())
