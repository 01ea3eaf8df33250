"""The cache of the frames: what is in it, where it is, and that a damaged one is never used."""

from __future__ import annotations

import errno
import logging
import pickle
import shutil
import tracemalloc
from collections import namedtuple
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from noise_world import write_noise

from dmotion_bench.errors import CacheNotWritable, DatasetCorrupt, StorageFull
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.recording.restore import repair_dataset
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.frame_cache import CacheFile, FrameCache, Mapped
from dmotion_bench.storage.lock import in_turn


def flip(path: Path, place: int, bit: int = 3) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1 << bit
    path.unlink()  # who has it mapped keeps it
    path.write_bytes(content)


def truth(dataset: Dataset) -> np.ndarray:
    return np.concatenate([dataset.video(number) for number in range(len(dataset))])


def test_the_cache_holds_every_frame(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    cache = dataset.cache()
    assert cache.offsets.tolist() == [0, *np.cumsum(dataset.lengths).tolist()]
    for number in range(len(dataset)):
        np.testing.assert_array_equal(cache.episode(number), dataset.video(number))
    np.testing.assert_array_equal(cache.frames, truth(dataset))
    assert not cache.frames.flags.writeable
    assert not cache.frames.flags.owndata
    assert cache.nbytes == cache.frames.nbytes
    assert pickle.loads(pickle.dumps(dataset)).cache() is not cache
    assert dataset.cache() is cache


def test_any_arrow_reader_opens_the_cache(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    frames = dataset.cache().frames
    (file,) = (dataset.path / "cache").iterdir()
    table = pa.ipc.open_file(file.read_bytes()).read_all()
    assert table.column_names == ["frame", "crc32"]
    read = [np.frombuffer(value, np.uint8) for value in table.column("frame").to_pylist()]
    np.testing.assert_array_equal(np.stack(read), frames.reshape(len(read), -1))


def test_a_stale_or_foreign_cache_is_made_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    old = write_noise(tmp_path / "old", episodes=3)
    new = write_noise(tmp_path / "new", episodes=5)
    old.cache()
    shutil.copytree(old.path / "cache", new.path / "cache")
    assert len(new.cache().frames) == new.lengths.sum()
    assert len(list((new.path / "cache").iterdir())) == 1  # the stale one is gone
    assert not caplog.records
    (file,) = (new.path / "cache").iterdir()
    file.unlink()
    file.write_bytes((old.path / "cache").iterdir().__next__().read_bytes())  # under the right name
    np.testing.assert_array_equal(Dataset.open(new.path).cache().episode(4), new.video(4))
    file.unlink()
    file.write_bytes(b"ARROW1 and then nothing")
    np.testing.assert_array_equal(Dataset.open(new.path).cache().episode(4), new.video(4))
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    assert "is made anew" in caplog.text


@pytest.mark.parametrize("damaged", [False, True])
def test_a_cache_that_another_process_has_just_made_is_taken(
    damaged: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = write_noise(tmp_path / "d")
    file, made = dataset.cache_file, []
    if damaged:
        dataset.cache()
        flip(file.path, file.path.read_bytes().index(truth(dataset)[0].tobytes()))
        dataset = Dataset.open(dataset.path)
        dataset.cache()  # mapped, not looked at

    def late(path: Path) -> AbstractContextManager[None]:
        file.build([truth(dataset)])  # by the one that was waited for
        made.append(path.stat().st_ino)
        return in_turn(path)

    monkeypatch.setattr("dmotion_bench.storage.frame_cache.in_turn", late)
    np.testing.assert_array_equal(dataset.cache().frames, truth(dataset))
    assert made == [file.path.stat().st_ino]
    assert list(file.folder.iterdir()) == [file.path]


def test_a_cache_of_the_version_without_checksums_is_made_anew(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    file, frames = dataset.cache_file, dataset.cache().frames
    kind = pa.binary(file.height * file.width * 3)
    schema = pa.schema([pa.field("frame", kind, False)]).with_metadata({"dmbench.fingerprint": dataset.fingerprint})
    file.path.unlink()
    with pa.ipc.new_file(str(file.path), schema) as writer:
        writer.write_batch(pa.record_batch([pa.array([bytes(3 * 6 * 5)] * len(frames), kind)], schema=schema))
    assert check_dataset(dataset.path).damages == ()
    np.testing.assert_array_equal(Dataset.open(dataset.path).cache().frames, truth(dataset))


@pytest.mark.parametrize(
    ("compression", "padded", "taken"),
    [(None, False, True), ("zstd", False, False), ("zstd", True, False), ("lz4", True, False)],
)
def test_a_cache_that_arrow_would_have_to_unpack_is_not_used(
    tmp_path: Path, compression: str | None, padded: bool, taken: bool
) -> None:
    file = CacheFile(folder=tmp_path, fingerprint="a" * 64, count=200, height=32, width=32)
    kinds = (pa.field("frame", pa.binary(32 * 32 * 3), False), pa.field("crc32", pa.uint32(), False))
    schema = pa.schema(kinds).with_metadata({"dmbench.fingerprint": file.fingerprint})
    columns = [pa.array([bytes(32 * 32 * 3)] * 200, kinds[0].type), pa.array(np.zeros(200, np.uint32))]
    with pa.ipc.new_file(str(file.path), schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as writer:
        writer.write_batch(pa.record_batch(columns, schema=schema))
    if padded:
        content = file.path.read_bytes()
        file.path.write_bytes(content + bytes(file.bytes + 2000 - len(content)))

    mapped = file.map()

    assert (mapped is not None) is taken
    assert (file.path.stat().st_size >= file.bytes) is (taken or padded)


@pytest.fixture(scope="module")
def cached(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    dataset = write_noise(tmp_path_factory.mktemp("cached") / "d", episodes=10)
    dataset.cache()
    return dataset


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=60)
@given(data=st.data())
def test_no_flipped_bit_gives_a_wrong_frame_and_the_check_finds_it(cached: Dataset, data: st.DataObject) -> None:
    frames = truth(cached)
    cached.cache_file.build([frames])
    whole = cached.cache_file.path.read_bytes()
    flip(cached.cache_file.path, data.draw(st.integers(0, len(whole) - 1)), data.draw(st.integers(0, 7)))
    dataset = Dataset.open(cached.path)
    found = check_dataset(cached.path).damages
    mapped = cached.cache_file.map()
    assert (
        not found if _equal(mapped, frames) else [one.file for one in found] == [f"cache/{cached.cache_file.path.name}"]
    )

    triplets = TripletSet.of(dataset.cache(), np.arange(len(dataset)))
    order = np.random.default_rng(0).permutation(len(triplets))
    for batch in np.array_split(order, 5):
        for row, first in zip(triplets.gather(batch), triplets.first_frame[batch].tolist(), strict=True):
            np.testing.assert_array_equal(row, frames[first : first + 3])
    for batch in HeldOut(Dataset.open(cached.path), "train").rollouts(1, 4):
        place = dataset.cache().offsets[batch.episode] + batch.start
        np.testing.assert_array_equal(batch.current, frames[place])
    for number in range(len(dataset)):
        np.testing.assert_array_equal(dataset.cache().episode(number), dataset.video(number))
    assert dataset.cache_file.path.read_bytes() == whole or _equal(mapped, frames)


def _equal(mapped: Mapped | None, frames: np.ndarray) -> bool:
    """Whether the flipped bit was padding."""
    return (
        mapped is not None
        and np.array_equal(mapped.frames, frames)
        and all(mapped.is_sound(place) for place in range(len(frames)))
    )


def test_damage_is_noticed_in_the_middle_of_a_training(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    dataset = write_noise(tmp_path / "d")
    frames = truth(dataset)
    dataset.cache()
    place = dataset.cache_file.path.read_bytes().index(frames[10].tobytes())
    flip(dataset.cache_file.path, place + 7)
    cache = Dataset.open(dataset.path).cache()
    np.testing.assert_array_equal(cache.checked(np.array([0, 4]), 3)[:7], frames[:7])
    assert not caplog.records
    np.testing.assert_array_equal(cache.checked(np.array([0, 9]), 3)[:12], frames[:12])
    assert len(caplog.records) == 1
    assert dataset.cache_file.path.name in caplog.text
    np.testing.assert_array_equal(cache.frames, frames)


def test_a_frame_in_anothers_place_is_noticed(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    frames = truth(dataset)
    mapped = dataset.cache_file.map()
    assert mapped is None
    sums = dataset.cache()._mapped.sums
    swapped = Mapped(frames[::-1], sums[::-1])
    assert not any(swapped.is_sound(place) for place in range(len(frames)) if 2 * place != len(frames) - 1)


def test_a_disk_that_does_not_keep_what_is_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = write_noise(tmp_path / "d")
    monkeypatch.setattr(Mapped, "is_sound", lambda *_: False)
    with pytest.raises(DatasetCorrupt, match=r"not reliable.*--cache DIR.*DMBENCH_CACHE"):
        _ = dataset.cache().frames


def test_a_poisoned_cache_with_right_checksums_is_found_by_the_check_and_deleted_by_the_repair(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    frames = truth(dataset)
    frames[5] ^= 1
    dataset.cache_file.build([frames])
    (damage,) = check_dataset(dataset.path).damages
    assert (damage.file, damage.shard) == (f"cache/{dataset.cache_file.path.name}", None)
    assert damage.what == "holds other frames than the video"
    assert repair_dataset(dataset.path).how == "cache"
    assert not dataset.cache_file.path.exists()
    assert check_dataset(dataset.path).damages == ()
    np.testing.assert_array_equal(Dataset.open(dataset.path).cache().episode(6), dataset.video(6))


def test_a_failed_cache_leaves_nothing(tmp_path: Path) -> None:
    frames = np.zeros((2, 4, 4, 3), np.uint8)
    file = CacheFile(folder=tmp_path, fingerprint="a" * 64, count=3, height=4, width=4)
    for episodes in ([frames], [frames, frames]):
        with pytest.raises(ValueError, match="frames were given"):
            file.build(episodes)
        assert not list(tmp_path.iterdir())
        assert file.map() is None


@pytest.mark.slow
def test_making_the_cache_holds_one_episode_in_memory(tmp_path: Path) -> None:
    """64 episodes of 3 MiB, 192 MiB in all, pass through 16 MiB of memory."""
    frames = np.arange(64 * 128 * 128 * 3, dtype=np.uint8).reshape(64, 128, 128, 3)
    file = CacheFile(folder=tmp_path, fingerprint="a" * 64, count=64 * 64, height=128, width=128)
    tracemalloc.start()
    file.build(frames for _ in range(64))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16 * 2**20
    cache = FrameCache(file, np.full(64, 64), lambda: pytest.fail("it is there"))
    np.testing.assert_array_equal(cache.episode(63), frames)


def test_another_process_maps_the_file_and_is_given_no_frames(tmp_path: Path) -> None:
    cache = write_noise(tmp_path / "d").cache()
    told = pickle.dumps(cache)

    assert cache.frames.tobytes() not in told
    np.testing.assert_array_equal(pickle.loads(told).frames, cache.frames)


def test_a_folder_that_cannot_be_written_names_the_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = write_noise(tmp_path / "d")
    with monkeypatch.context() as patch:  # root may write anywhere, so the system is made to refuse
        patch.setattr("os.access", lambda *_: False)
        with pytest.raises(CacheNotWritable, match=r"--cache DIR.*DMBENCH_CACHE"):
            dataset.cache()
    with monkeypatch.context() as patch:
        read_only = OSError(errno.EROFS, "Read-only file system")
        patch.setattr(Path, "mkdir", lambda *_, **__: (_ for _ in ()).throw(read_only))
        with pytest.raises(CacheNotWritable, match="Read-only file system"):
            dataset.cache()
    (tmp_path / "file").touch()
    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path / "file"))
    with pytest.raises(CacheNotWritable, match="File exists"):
        dataset.cache()

    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path / "elsewhere" / "deep"))
    other = write_noise(tmp_path / "other", episodes=3)
    other.cache()
    np.testing.assert_array_equal(dataset.cache().frames, truth(dataset))
    assert not list((dataset.path / "cache").iterdir())
    assert len(list((tmp_path / "elsewhere" / "deep").iterdir())) == 2  # one data set leaves the other's alone


def test_a_cache_that_does_not_fit_is_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = write_noise(tmp_path / "d")
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9, 1000))
    with pytest.raises(StorageFull, match=r"GiB as a cache.*--cache DIR"):
        dataset.cache()
    assert not list((dataset.path / "cache").iterdir())
