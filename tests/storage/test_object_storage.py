"""Data sets on object storage: a real S3 server on the loopback address, and every way in which it can fail."""

from __future__ import annotations

import errno
import pickle
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from dmbench_command import dmbench
from noise_world import assert_same_episode, files_of, write_noise
from object_storage import FAULTS, Storage, object_storage

from dmotion_bench.addresses import remote_address
from dmotion_bench.errors import (
    DatasetCorrupt,
    DatasetMissing,
    InvalidSetting,
    LabelsNotAvailable,
    PackageNotInstalled,
    PlaceUnreachable,
    StorageFull,
    UsageError,
)
from dmotion_bench.recording.restore import repair_dataset
from dmotion_bench.storage import object_store
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import held
from dmotion_bench.storage.remote_copy import RemoteCopy, copy_folder, upload
from dmotion_bench.storage.summary import summarize


@pytest.fixture(scope="module")
def server():
    with object_storage() as storage:
        yield storage


@pytest.fixture(scope="module")
def noise(tmp_path_factory) -> Dataset:
    """Seven episodes in three shards."""
    return write_noise(tmp_path_factory.mktemp("data") / "noise")


@pytest.fixture
def storage(server, tmp_path, monkeypatch, request) -> Storage:
    """The server as a test finds it: a prefix of its own, no fault, and no copies."""
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    impatient = "silent" in request.node.name
    return server.as_found(monkeypatch, request.node.name, patience_s=0.2 if impatient else 10.0)


@pytest.fixture(scope="module")
def put(server, noise, tmp_path_factory) -> str:
    """The address of the noise, for tests that leave it as it is."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in server.environment.items():
            patch.setenv(name, value)
        patch.setenv("DMBENCH_WORKSPACE", str(tmp_path_factory.mktemp("workspace")))
        upload(noise.path, "s3://data/sets/noise")
    return "s3://data/sets/noise"


@pytest.fixture
def remote(storage, put) -> Dataset:
    return Dataset.open(put)


@pytest.fixture
def own(storage, noise) -> Dataset:
    """One that a test may spoil."""
    upload(noise.path, f"{storage.address}/noise")
    return Dataset.open(f"{storage.address}/noise")


class Faults:
    """Spoils the first few answers of a kind."""

    def __init__(self, kind: str, times: int, ending: str = ".mcap", method: str = "GET") -> None:
        self.kind, self.left, self.ending, self.method = kind, times, ending, method

    def __call__(self, method: str, path: str) -> str | None:
        if method != self.method or not path.partition("?")[0].endswith(self.ending) or not self.left:
            return None
        self.left -= 1
        return self.kind


def copies(remote: Dataset) -> list[Path]:
    return [file for kind in ("video", "labels") for file in sorted((remote.path / kind).glob("*"))]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    ("given", "address"),
    [
        ("s3://bucket/a/b", "s3://bucket/a/b"),
        (Path("s3://bucket/a/b"), "s3://bucket/a/b"),
        ("gs://bucket/a/", "gs://bucket/a"),
        ("hf://datasets/who/what", "hf://datasets/who/what"),
        ("s3:", None),
        ("s3:///", None),
        ("data/s3://x", None),
        ("C:/data", None),
        ("file:///etc", None),
        (None, None),
    ],
)
def test_addresses_are_told_from_paths(given, address) -> None:
    assert remote_address(given) == address


@pytest.mark.slow
def test_an_address_holds_the_data_set_that_was_put_there(remote, noise, storage) -> None:
    assert (remote.name, remote.fingerprint, remote.where) == ("noise", noise.fingerprint, "s3://data/sets/noise")
    assert remote.tasks() == noise.tasks()
    assert not copies(remote)  # nothing but the tables is here yet
    for number in range(len(noise)):
        assert_same_episode(remote.episode(number), noise.episode(number))
    assert storage.count("GET", ".mcap") == 6  # each file once
    again = Dataset.open(Path(remote.where))
    assert_same_episode(pickle.loads(pickle.dumps(again)).episode(3), noise.episode(3))
    assert storage.count("GET", ".mcap") == 6
    np.testing.assert_array_equal(again.cache().frames, noise.cache().frames)
    assert contents(again.path).items() >= files_of(noise.path).items()


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULTS)
def test_what_fails_for_a_while_is_asked_for_again(remote, noise, storage, kind, monkeypatch) -> None:
    slept = list[float]()
    monkeypatch.setattr("time.sleep", slept.append)
    storage.fault = Faults(kind, 2)
    np.testing.assert_array_equal(remote.video(4), noise.video(4))
    assert storage.count("GET", ".mcap") == 3
    pauses = [pause for pause in slept if pause in object_store.PAUSES]
    again = 1 if kind == "broken" else 2  # a connection that breaks off is opened once more by the client itself
    assert pauses == list(object_store.PAUSES[:again])


@pytest.mark.parametrize("kind", FAULTS)
def test_what_fails_for_good_costs_a_sentence_and_leaves_nothing(remote, storage, kind) -> None:
    storage.fault = Faults(kind, 1000)
    wrong = kind in ("wrong", "short")
    with pytest.raises(DatasetCorrupt if wrong else PlaceUnreachable) as caught:
        remote.video(0)
    said = str(caught.value)
    assert f"{remote.where}/video/shard-00000.mcap" in said
    assert ("Nothing of it is used." if wrong else "failed 4 times: ") in said
    assert not copies(remote)


@pytest.mark.parametrize("name", ["dataset.json", "episodes.parquet", "tasks.parquet"])
@pytest.mark.parametrize("kind", ["wrong", "short", "503"])
def test_a_table_is_never_read_wrongly(put, noise, storage, name, kind) -> None:
    storage.fault = Faults(kind, 1, name)
    assert Dataset.open(put).tasks() == noise.tasks()
    storage.fault = Faults(kind, 1000, name)
    shutil.rmtree(copy_folder(put))
    with pytest.raises((DatasetCorrupt, PlaceUnreachable)):
        Dataset.open(put)


def test_two_readings_that_differ_are_not_believed(put, storage) -> None:
    """Every second answer is cut short: no two in a row agree."""
    every = iter(range(1000))
    storage.fault = lambda _, path: "short" if path.endswith("dataset.json") and next(every) % 2 else None
    with pytest.raises(PlaceUnreachable, match=r"failed 4 times: .*two readings of it differ"):
        Dataset.open(put)


def test_a_file_that_is_there_in_part_or_not_at_all_is_damage(own, noise, storage) -> None:
    own.remote.store.write(noise.path / "video" / "shard-00001.mcap", "video/shard-00000.mcap")
    own.remote.store.remove("labels/shard-00002.mcap")
    with pytest.raises(DatasetCorrupt, match=r"video/shard-00000.mcap' is damaged: it has \d+ bytes instead of \d+"):
        Dataset.open(own.where)
    with pytest.raises(LabelsNotAvailable, match=r"are not there; put the folder labels/ there, too"):
        own.labels(6)
    with pytest.raises(DatasetCorrupt, match=r"bytes of it come|does not hold the bytes"):
        own.video(0)
    right, other = ((noise.path / "video" / f"shard-0000{number}.mcap").stat().st_size for number in (0, 1))
    report = check_dataset(Path(own.where))
    assert {(damage.file, damage.what) for damage in report.damages} == {
        ("video/shard-00000.mcap", f"has {other} bytes instead of {right}"),
        ("labels/shard-00002.mcap", "is missing"),
    }
    with pytest.raises(UsageError, match="is on object storage, where nothing is mended"):
        repair_dataset(Path(own.where))


def test_more_bytes_than_were_recorded_are_damage(own, noise, storage, tmp_path) -> None:
    longer = {}
    for name in ("labels/shard-00001.mcap", "episodes.parquet"):
        (tmp_path / "longer").write_bytes((noise.path / name).read_bytes() + b"x")
        own.remote.store.write(tmp_path / "longer", name)
        size = (noise.path / name).stat().st_size
        longer[name] = f"has {size + 1} bytes instead of {size}"
    assert {damage.file: damage.what for damage in check_dataset(Path(own.where)).damages} == longer


@pytest.mark.parametrize("wrong", [{"size": -1}, {"size": 2**63}, {"size": "12"}, {"name": None}, {"type": 7}])
def test_a_list_that_cannot_be_is_asked_for_again_and_then_a_sentence(own, monkeypatch, wrong) -> None:
    system = own.remote.store._connected()
    right = system.ls
    monkeypatch.setattr(system, "ls", lambda *given, **more: [one | wrong for one in right(*given, **more)])
    with pytest.raises(PlaceUnreachable, match=r"failed 4 times: .*its list says no name, kind or size of a file"):
        own.remote.sizes("video")


def test_a_copy_that_the_disk_has_spoilt_is_noticed_and_the_check_mends_it(remote, noise) -> None:
    remote.video(0)
    (copy,) = copies(remote)
    content = bytearray(copy.read_bytes())
    content[remote.rows[0].video.offset + 60] ^= 0xFF
    copy.write_bytes(content)
    with pytest.raises(DatasetCorrupt, match=r"the copy of a file of .* is damaged: it .* Delete it"):
        remote.video(0)
    assert not check_dataset(Path(remote.where)).damages
    np.testing.assert_array_equal(remote.video(0), noise.video(0))


def test_copies_make_room_for_each_other(remote, noise, monkeypatch) -> None:
    largest = max(shard.video.size for shard in noise.manifest.shards)
    monkeypatch.setenv("DMBENCH_REMOTE_GIB", str(1.2 * largest / 2**30))
    for number in (0, 6, 3, 0, 1, 5):
        np.testing.assert_array_equal(remote.video(number), noise.video(number))
        assert len(copies(remote)) == 1
    monkeypatch.setenv("DMBENCH_REMOTE_GIB", "much")
    with pytest.raises(InvalidSetting, match="DMBENCH_REMOTE_GIB is 'much'; it can be a number of GiB above zero"):
        remote.video(6)


def test_threads_that_want_the_same_file_fetch_it_once(remote, noise, storage) -> None:
    read = list[np.ndarray]()
    threads = [threading.Thread(target=lambda: read.append(remote.video(1))) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert storage.count("GET", ".mcap") == 1
    assert all(np.array_equal(frames, noise.video(1)) for frames in read)
    assert len(read) == 6


def test_dataset_json_comes_last_and_what_is_there_is_not_sent_again(noise, storage, monkeypatch) -> None:
    storage.fault = Faults("500", 1000, "shard-00002.mcap", "PUT")
    with pytest.raises(PlaceUnreachable, match=r"shard-00002.mcap' failed 4 times: "):
        upload(noise.path, f"{storage.address}/noise")
    with pytest.raises(DatasetMissing, match=r"no data set in 's3://.*': there is no dataset.json; name another place"):
        Dataset.open(f"{storage.address}/noise")
    storage.fault = Faults("truncated", 2, "", "PUT")
    storage.seen.clear()
    upload(noise.path, f"{storage.address}/noise")
    assert [path for method, path in storage.seen if method == "PUT"][-1].endswith("/dataset.json")
    storage.seen.clear()
    upload(noise.path, f"{storage.address}/noise")
    assert [path.rpartition("/")[2] for method, path in storage.seen if method == "PUT"] == ["dataset.json"]
    assert storage.count("DELETE") == 0


@pytest.mark.slow
def test_another_data_set_at_the_address_replaces_the_copies(own, noise, storage, tmp_path) -> None:
    own.video(0)
    other = write_noise(tmp_path / "other", episodes=12, shard_episodes=4)
    upload(other.path, own.where)
    again = Dataset.open(own.where)
    assert again.fingerprint == other.fingerprint
    np.testing.assert_array_equal(again.video(1), other.video(1))


def test_what_cannot_help_is_not_asked_for_again(storage, monkeypatch) -> None:
    with pytest.raises(DatasetMissing, match=r"there is no dataset.json"):
        Dataset.open("s3://no-such-bucket/noise")
    assert len(storage.seen) == 1
    with pytest.raises(PackageNotInstalled, match=r"reading 'gs://bucket/noise' needs the package 'gcsfs', .*: pip"):
        Dataset.open("gs://bucket/noise")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nowhere")
    monkeypatch.setenv("AWS_CONFIG_FILE", "/nowhere")
    with pytest.raises((PlaceUnreachable, DatasetMissing)):
        Dataset.open(f"{storage.address}/noise")


def test_a_full_disk_is_no_fault_of_the_storage(remote, storage, monkeypatch) -> None:
    def full(_file: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    storage.seen.clear()
    with pytest.raises(StorageFull, match="no space left on the device while writing"):
        remote.video(0)
    assert storage.count("GET", ".mcap") == 1
    assert not copies(remote)


def test_a_copied_table_that_cannot_be_read_is_to_be_deleted(remote) -> None:
    (remote.path / "tasks.parquet").write_bytes(b"x")
    with pytest.raises(DatasetCorrupt, match=r"the copy of a file of 's3://.*', is damaged: .* Delete it, and it is"):
        remote.tasks()
    assert Dataset.open(remote.where).tasks() == []


@pytest.mark.slow
def test_commands_take_addresses(own, noise, storage, capsys, monkeypatch) -> None:
    summary = summarize(Path(own.where))
    ours = summarize(noise.path)
    for name in ("episodes", "frames", "labels", "video_bytes", "labels_bytes", "fingerprint"):
        assert summary[name] == ours[name]
    told = dmbench(["data", "check", own.where], capsys, monkeypatch)
    assert (told.code, told.out) == (0, f"{own.where} is sound: 7 episodes, 26 frames, labels present.\n")
    own.remote.store.remove("video/shard-00001.mcap")
    shutil.rmtree(own.path)
    told = dmbench(["data", "check", own.where], capsys, monkeypatch)
    assert told.code == 1
    assert told.out == "video/shard-00001.mcap is missing\n"
    assert told.sentence() == f"dmbench: {own.where!r} is damaged in 1 places; put it there again.\n"


@pytest.mark.slow
def test_recording_to_an_address_puts_the_same_bytes_there(storage, tmp_path, capsys, monkeypatch) -> None:
    where = f"{storage.address}/grid"
    words = ["record", "grid_world", "--preset", "tiny", "--frames", "4", "--workers", "1", "--episodes"]
    assert dmbench([*words, "23", "--out", str(tmp_path / "grid")], capsys, monkeypatch).code == 0
    assert dmbench([*words, "12", "--out", where], capsys, monkeypatch).code == 0
    assert dmbench([*words, "12", "--out", where], capsys, monkeypatch).out.count("complete already") == 1
    assert dmbench([*words, "23", "--out", where], capsys, monkeypatch).code == 0  # extended
    report = check_dataset(Path(where))
    assert not report.damages
    assert contents(RemoteCopy(where).folder).items() >= files_of(tmp_path / "grid").items()
    assert not list(tmp_path.rglob("*-recording"))
    with held(copy_folder(where, "-recorder")):  # by whoever records there, puts it there, and deletes the folder
        told = dmbench([*words, "24", "--out", where], capsys, monkeypatch)
    assert told.code == 1
    assert "another dmbench is writing" in told.err
    told = dmbench([*words, "23", "--seed", "1", "--out", where], capsys, monkeypatch)
    assert told.code == 1
    assert f"{where!r} holds a data set of another recipe: seed is 0 there and 1 here" in told.err
