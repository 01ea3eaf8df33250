"""Damaged and forged MCAP files: a sentence that helps, bounded memory, and nothing left behind."""

from __future__ import annotations

import struct
import zlib
from functools import partial
from pathlib import Path

import foxglove
import lz4.frame
import numpy as np
import pytest
import zstandard
from foxglove.mcap import MCAPWriteOptions
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as OfficialWriter
from storage.foreign import (
    START,
    compressed,
    foxglove_compressed_file,
    foxglove_file,
    ros_file,
    ros_image,
    steady,
    video,
)
from storage.hand_made import SMALL, by_hand, chunk, peak_of, record, refused

from dmotion_bench.errors import RecordingImportError, RecordingTruncated
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions


@given(cut=st.floats(0, 1))
@settings(deadline=None, derandomize=True, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_cut_anywhere_is_refused(good: Path, tmp_path_factory: pytest.TempPathFactory, cut: float) -> None:
    folder = tmp_path_factory.mktemp("cut")
    whole = good.read_bytes()
    (folder / "a.mcap").write_bytes(whole[: int(cut * (len(whole) - 30))])
    refused(folder / "a.mcap", folder, "is cut off|no MCAP file|is empty|is no recording")


def test_a_cut_file_can_be_salvaged(good: Path, tmp_path: Path) -> None:
    whole = good.read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(RecordingTruncated, match=r"ends in the middle of a record.*'--salvage'"):
        import_recordings([tmp_path / "a.mcap"], tmp_path / "out", SMALL)
    report = import_recordings([tmp_path / "a.mcap"], tmp_path / "out", ImportOptions(size=32, salvage=True))

    dataset = Dataset.open(tmp_path / "out")
    frames = dataset.video(0)
    assert 5 <= len(frames) < 12
    assert report.advice[0] == (
        f"{str(tmp_path / 'a.mcap')!r} is cut off or damaged after {len(frames)} pictures "
        f"({(len(frames) - 1) / 10:.1g} s); what follows is left out."
    )
    np.testing.assert_array_equal(frames, video(12)[: len(frames)])


def test_a_file_that_is_cut_behind_its_last_message_lacks_nothing(good: Path, tmp_path: Path) -> None:
    whole = good.read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[:-30])
    report = import_recordings([tmp_path / "a.mcap"], tmp_path / "out", ImportOptions(size=32, salvage=True))
    assert report.frames == 12
    assert not any("is cut off" in sentence for sentence in report.advice)


@pytest.mark.slow
@given(place=st.floats(0, 1), value=st.integers(0, 255))
@settings(deadline=None, derandomize=True, max_examples=150)
def test_a_changed_byte_never_surprises(
    good: Path, tmp_path_factory: pytest.TempPathFactory, place: float, value: int
) -> None:
    folder = tmp_path_factory.mktemp("changed")
    content = bytearray(good.read_bytes())
    content[int(place * (len(content) - 1))] = value
    (folder / "a.mcap").write_bytes(content)
    try:
        import_recordings([folder / "a.mcap"], folder / "out", SMALL)
    except RecordingImportError:
        assert [path.name for path in folder.iterdir()] == ["a.mcap"]


def test_a_damaged_chunk_is_found_by_its_checksum(tmp_path: Path) -> None:
    file = foxglove_file(tmp_path / "a.mcap", video(5), steady(5), options=MCAPWriteOptions(compression=None))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    refused(file, tmp_path, "is damaged near byte .*checksum does not match")


def test_nothing_of_a_chunk_with_a_wrong_checksum_is_salvaged(tmp_path: Path) -> None:
    frames = video(9)
    options = MCAPWriteOptions(compression=None, chunk_size=4 * frames[0].nbytes)
    file = foxglove_file(tmp_path / "a.mcap", frames, steady(9), options=options)
    content = bytearray(file.read_bytes())
    place = content.index(frames[6].tobytes()) + frames[6].nbytes // 2
    content[place] ^= 0xFF
    file.write_bytes(content)
    refused(file, tmp_path, "is damaged near byte .*checksum does not match")

    report = import_recordings([file], tmp_path / "out", ImportOptions(size=32, salvage=True))
    found = Dataset.open(tmp_path / "out").video(0)
    assert 3 <= len(found) <= 6
    assert any(f"damaged after {len(found)} pictures (" in sentence for sentence in report.advice)
    np.testing.assert_array_equal(found, frames[: len(found)])


def test_a_chunk_that_declares_too_much(tmp_path: Path) -> None:
    file = by_hand(tmp_path / "a.mcap", chunk(zstandard.compress(b"\0" * 100), declared=2**40))
    refused(file, tmp_path, r"declares 1,048,576 MiB, more than the 1,024 MiB .*'--max-chunk 1048576'")


def test_a_chunk_that_inflates_to_more_than_it_declares(tmp_path: Path) -> None:
    unknown = record(0x7F, b"\0" * 91)
    bomb = zstandard.compress(unknown + b"\0" * 50 * MIB)
    file = by_hand(tmp_path / "a.mcap", chunk(bomb, declared=len(unknown)))
    assert peak_of(lambda: refused(file, tmp_path, "inflates to more than it declares")) < 8 * MIB


def test_a_compressed_file_that_is_cut_off_or_damaged(tmp_path: Path) -> None:
    packed = zstandard.compress(foxglove_file(tmp_path / "a.mcap", video(12, 128, 128), steady(12)).read_bytes())
    (tmp_path / "short.mcap.zst").write_bytes(packed[:50])
    refused(tmp_path / "short.mcap.zst", tmp_path, "short.mcap.zst' is cut off")
    (tmp_path / "a.mcap.zst").write_bytes(packed[: len(packed) * 2 // 3])
    refused(tmp_path / "a.mcap.zst", tmp_path, "is cut off|holds less than it declares; .*'--salvage'")
    salvaged = import_recordings([tmp_path / "a.mcap.zst"], tmp_path / "out", ImportOptions(size=32, salvage=True))
    assert 4 <= salvaged.frames < 12
    assert any(f"a.mcap.zst' is cut off or damaged after {salvaged.frames} p" in told for told in salvaged.advice)
    damaged = bytearray(packed)
    damaged[len(packed) // 2 :] = bytes(len(packed) - len(packed) // 2)
    (tmp_path / "b.mcap.zst").write_bytes(damaged)
    refused(tmp_path / "b.mcap.zst", tmp_path, "is cut off|is damaged near byte")


def test_a_compressed_file_that_inflates_without_end(tmp_path: Path) -> None:
    compressor = zstandard.ZstdCompressor().compressobj()
    unknown = record(0x7F, bytes(MIB))
    packed = b"".join(compressor.compress(unknown) for _ in range(300)) + compressor.flush()
    content = zstandard.compress(by_hand(tmp_path / "b.mcap").read_bytes()[:-50])  # up to the end of its data
    (tmp_path / "a.mcap.zst").write_bytes(content + packed)
    tight = ImportOptions(limits=ImportLimits(chunk_bytes=MIB))
    match = "it inflates to more than 1,000 times its size"
    assert peak_of(lambda: refused(tmp_path / "a.mcap.zst", tmp_path, match, tight)) < 16 * MIB


def test_a_compressed_message_that_inflates_without_end(tmp_path: Path) -> None:
    bomb, wrong = zstandard.compress(bytes(50 * MIB)), zstandard.compress(b"x" * 500)[:-5] + b"12345"
    for name, data, match in (
        ("bomb", bomb, "inflates to more than the 10 MiB"),
        ("wrong", wrong, "cannot be inflated"),
    ):
        with (tmp_path / f"{name}.mcap").open("wb") as opened:
            writer = OfficialWriter(opened)
            writer.start()
            channel = writer.register_channel(
                "/c", "cdr", writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
            )
            writer.add_message(channel, START, data, START)
            writer.finish()
        options = ImportOptions(limits=ImportLimits(message_bytes=10 * MIB))
        run = partial(refused, tmp_path / f"{name}.mcap", tmp_path, match, options)
        assert peak_of(run) < 32 * MIB


def test_a_chunk_that_inflates_to_less_than_it_declares(tmp_path: Path) -> None:
    file = by_hand(tmp_path / "a.mcap", chunk(zstandard.compress(record(0x7F, b"\0" * 91)), declared=1000))
    refused(file, tmp_path, "a chunk holds less than it declares")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_is_no_longer_what_was_compressed(tmp_path: Path, compression: str) -> None:
    content = record(0x7F, np.random.default_rng(0).bytes(5000))
    stored = (zstandard.compress if compression == "zstd" else lz4.frame.compress)(content)
    for number, damaged in enumerate((stored[:-4], stored[:9], b"", b"\xff" * 50, stored[:2000] + stored[2100:])):
        file = by_hand(tmp_path / f"{number}.mcap", chunk(damaged, len(content), compression=compression))
        refused(file, tmp_path, "is damaged near byte .*(cannot be inflated|holds less than it declares)")


@pytest.mark.parametrize("opcode", [0x05, 0x7F], ids=["message", "unknown record"])
def test_a_bomb_of_a_record_is_not_held(tmp_path: Path, opcode: int) -> None:
    body = struct.pack("<HIQQ", 1, 0, START, START) + b"\0" * 40 * MIB
    content = record(opcode, body)
    file = by_hand(tmp_path / "a.mcap", chunk(zstandard.compress(content), len(content), zlib.crc32(content)))
    options = ImportOptions(limits=ImportLimits(message_bytes=20 * MIB))
    match = "has a message of 40 MiB on '/camera', more than the 20 MiB" if opcode == 0x05 else "has no pictures"
    del body, content
    assert peak_of(lambda: refused(file, tmp_path, match, options)) < 8 * MIB


def test_a_chunk_of_zeros_is_no_records(tmp_path: Path) -> None:
    compressor = zstandard.ZstdCompressor().compressobj()
    zeros = b"".join(compressor.compress(bytes(MIB)) for _ in range(500)) + compressor.flush()  # 58 million of kind 0
    file = by_hand(tmp_path / "a.mcap", chunk(zeros, 500 * MIB))
    assert peak_of(lambda: refused(file, tmp_path, "a record is of kind 0, which no record is")) < 8 * MIB


def test_a_length_that_lies_is_not_allocated(tmp_path: Path) -> None:
    for size in (2**34, 2**63, 2**64 - 1):
        file = by_hand(tmp_path / "a.mcap", record(0x05, b"\0" * 30, declared=size))
        assert peak_of(lambda file=file: refused(file, tmp_path, "is cut off")) < 8 * MIB


def test_a_picture_that_declares_more_than_it_has(tmp_path: Path) -> None:
    message = ros_image(START, 8000, 8000, "rgb8", 24_000, bytes(48))
    file = ros_file(tmp_path / "bag", [("/camera", "sensor_msgs/msg/Image", START, message)])
    match = "declares 8000x8000 pixels of rgb8, 192,000,000 bytes, but has 48"
    assert peak_of(lambda: refused(file, tmp_path, match)) < 8 * MIB


def test_a_damaged_picture_leaves_nothing_behind(tmp_path: Path) -> None:
    pictures = [compressed(frame, "jpeg") for frame in video(8)]
    pictures[6] = pictures[6][:-200]
    file = foxglove_compressed_file(tmp_path / "a.mcap", pictures, steady(8), "jpeg")
    refused(file, tmp_path, "message 6 on '/camera' is a damaged JPEG file.*; import the others with '--salvage'")

    report = import_recordings([file], tmp_path / "salvaged", ImportOptions(size=32, salvage=True))
    frames = Dataset.open(report.path).video(0)
    assert (report.unreadable, len(frames)) == (1, 8)
    np.testing.assert_array_equal(frames[6], frames[5])
    assert (frames[5] != frames[4]).any()
    assert (frames[7] != frames[6]).any()


@pytest.mark.parametrize("left", [0, 1, 60])
def test_of_a_picture_of_which_hardly_anything_is_left_the_one_before_is_taken(tmp_path: Path, left: int) -> None:
    pictures = [compressed(frame, "jpeg") for frame in video(8)]
    pictures[6] = pictures[6][:left]
    file = foxglove_compressed_file(tmp_path / "a.mcap", pictures, steady(8), "jpeg")
    refused(file, tmp_path, r"message 6 on '/camera' .*; import the others with '--salvage'\.")
    report = import_recordings([file], tmp_path / "salvaged", ImportOptions(size=32, salvage=True))
    frames = Dataset.open(report.path).video(0)
    assert (report.unreadable, len(frames)) == (1, 8)
    np.testing.assert_array_equal(frames[6], frames[5])


def test_where_the_first_picture_is_damaged_there_is_none_to_repeat(tmp_path: Path) -> None:
    pictures = [compressed(frame, "jpeg") for frame in video(8)]
    pictures[0] = pictures[0][: len(pictures[0]) // 2]
    file = foxglove_compressed_file(tmp_path / "a.mcap", pictures, steady(8), "jpeg")
    with pytest.raises(RecordingImportError, match="no whole picture comes before it"):
        import_recordings([file], tmp_path / "out", ImportOptions(size=32, salvage=True))
    assert not (tmp_path / "out").exists()


def test_salvage_is_not_said_to_help_where_the_first_picture_is_none(tmp_path: Path) -> None:
    file = foxglove_compressed_file(tmp_path / "a.mcap", [b"", compressed(video(1)[0], "jpeg")], steady(2), "jpeg")
    with pytest.raises(RecordingImportError, match=r"message 0 on '/camera' .* 0 bytes are no JPEG") as caught:
        import_recordings([file], tmp_path / "out", ImportOptions(size=32))
    assert "--salvage" not in str(caught.value)


def test_nothing_can_be_salvaged_of_a_first_chunk_that_is_cut(good: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(good.read_bytes()[:300])
    with pytest.raises(
        RecordingTruncated, match="nothing whole stands before that: '--salvage' finds nothing to import"
    ):
        import_recordings([tmp_path / "cut.mcap"], tmp_path / "out", ImportOptions(size=32, salvage=True))


def test_messages_that_are_not_what_they_say(tmp_path: Path) -> None:
    for number, data in enumerate((b"\xff" * 40, b"\x0a\xff\xff\xff\xff\x0f")):
        context = foxglove.Context()
        file = tmp_path / f"{number}.mcap"
        with foxglove.open_mcap(file, context=context):
            schema = foxglove.Schema(name="foxglove.RawImage", encoding="protobuf", data=b"")
            camera = foxglove.Channel("/camera", schema=schema, message_encoding="protobuf", context=context)
            camera.log(data, log_time=START)
        refused(file, tmp_path, "message 0 on '/camera' cannot be decoded as foxglove.RawImage")
