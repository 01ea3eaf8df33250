"""Whatever happens to the bytes, a wrong frame never comes out and memory is never set aside for a lie."""

from __future__ import annotations

import contextlib
import json
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
from noise_world import write_noise

from dmotion_bench.errors import DatasetCorrupt, DatasetError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.mcap_reader import DamagedFile, list_sections, read_messages
from dmotion_bench.storage.mcap_writer import CHUNK_HEAD, RECORD_HEAD, Span
from dmotion_bench.storage.messages import chunk_limit
from dmotion_bench.storage.shard import shard_path
from dmotion_bench.workspace import DATASET_MANIFEST

_CHUNK_AT = RECORD_HEAD.size  # from the start of the record


@pytest.fixture(scope="module")
def shard(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """One shard of three episodes."""
    return write_noise(tmp_path_factory.mktemp("damage") / "d", episodes=3)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=150)
@given(data=st.data())
def test_a_flipped_bit_never_gives_a_wrong_frame(shard: Dataset, data: st.DataObject) -> None:
    file = shard_path(shard.path, "video", 0)
    whole = file.read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    damaged = bytearray(whole)
    damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    truth = [shard.video(number) for number in range(3)]
    file.write_bytes(damaged)
    try:
        for number in range(3):
            try:
                frames = shard.video(number)
            except DatasetCorrupt as error:
                assert "dmbench data repair" in str(error)  # noqa: PT017 (either outcome is right)
            else:
                np.testing.assert_array_equal(frames, truth[number])
    finally:
        file.write_bytes(whole)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(data=st.data())
def test_of_a_truncated_file_every_whole_episode_is_found(shard: Dataset, data: st.DataObject) -> None:
    """As many as the official reader finds when it is told to stop sorting by time."""
    file = shard_path(shard.path, "video", 0)
    whole = file.read_bytes()
    length = data.draw(st.integers(0, len(whole) - 1))
    file.write_bytes(whole[:length])
    try:
        theirs = 0
        with file.open("rb") as stream, contextlib.suppress(EndOfFile, struct.error):
            for _ in NonSeekingReader(stream).iter_messages(log_time_order=False):
                theirs += 1
        ours = 0
        for section in list_sections(file, most=10, salvage=True):
            messages = list(read_messages(file, section.span, chunk_limit=10**6))
            assert len(messages) in (0, int(section.values["frames"]))
            ours += len(messages)
        assert ours == theirs
    finally:
        file.write_bytes(whole)


def test_opening_notices_a_truncated_shard(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    file = shard_path(dataset.path, "video", 1)
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(DatasetCorrupt, match=r"shard-00001.mcap.*dmbench data repair"):
        Dataset.open(dataset.path)


def _with_chunk_head(shard: Dataset, uncompressed: int) -> bytes:
    """The shard's bytes with another declared size in the first chunk."""
    raw = bytearray(shard_path(shard.path, "video", 0).read_bytes())
    at = shard.rows[0].video.offset + _CHUNK_AT
    first, last, _, crc = CHUNK_HEAD.unpack_from(raw, at)
    CHUNK_HEAD.pack_into(raw, at, first, last, uncompressed, crc)
    return bytes(raw)


def test_a_chunk_that_claims_a_terabyte_is_refused_before_memory_is_set_aside(shard: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "hostile.mcap"
    file.write_bytes(_with_chunk_head(shard, 2**40))
    tracemalloc.start()
    with pytest.raises(DamagedFile, match="claims 1099511627776 bytes"):
        list(read_messages(file, shard.rows[0].video, chunk_limit=chunk_limit(shard.spec)))
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_a_chunk_whose_compressed_data_claims_more_than_its_head_is_refused(tmp_path: Path) -> None:
    """zstandard allocates what the compressed data declares, so that must be looked at first."""
    bomb = zstandard.ZstdCompressor().compress(bytes(2**26))
    head = CHUNK_HEAD.pack(0, 0, 100, 0) + struct.pack("<I4sQ", 4, b"zstd", len(bomb))
    file = tmp_path / "bomb.mcap"
    file.write_bytes(RECORD_HEAD.pack(6, len(head) + len(bomb)) + head + bomb)
    with pytest.raises(DamagedFile, match="contradicts itself"):
        list(read_messages(file, Span(0, file.stat().st_size), chunk_limit=2**30))


@settings(deadline=None, derandomize=True, max_examples=100)
@given(garbage=st.binary(max_size=200))
def test_garbage_is_damage_and_nothing_else(garbage: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.getbasetemp() / "garbage.mcap"
    file.write_bytes(b"\x89MCAP0\r\n" + garbage)
    with pytest.raises(DamagedFile):
        list_sections(file, most=10)
    with contextlib.suppress(DamagedFile):
        list(read_messages(file, Span(8, len(garbage)), chunk_limit=1000))


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=120)
@given(data=st.data())
def test_any_manifest_is_read_or_refused(shard: Dataset, data: st.DataObject) -> None:
    """One value anywhere in dataset.json is replaced by any other."""
    content: Any = shard.manifest.to_json()
    holder, keys = content, list(content)
    key = data.draw(st.sampled_from(keys))
    while isinstance(holder[key], dict | list) and holder[key] and data.draw(st.booleans()):
        holder = holder[key]
        key = data.draw(st.sampled_from(list(holder) if isinstance(holder, dict) else range(len(holder))))
    holder[key] = data.draw(ANY_JSON)
    manifest = shard.path / DATASET_MANIFEST
    whole = manifest.read_bytes()
    manifest.write_text(json.dumps(content))
    try:
        opened = Dataset.open(shard.path)
        assert opened.lengths.sum() == shard.lengths.sum()
    except DatasetError as error:
        assert "dmbench" in str(error)  # noqa: PT017 (either outcome is right)
    finally:
        manifest.write_bytes(whole)
