"""Bad recordings: a sentence that helps, bounded memory, and nothing left behind."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import foxglove
import lz4.frame
import numpy as np
import pytest
import zstandard
from foxglove.channels import RawImageChannel
from foxglove.mcap import MCAPWriteOptions
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as OfficialWriter
from storage.foreign import (
    START,
    compressed,
    foxglove_compressed_file,
    foxglove_file,
    raw_image,
    ros_file,
    ros_image,
    steady,
    video,
)

from dmotion_bench.errors import InvalidSetting, RecipeMismatch, RecordingImportError, RecordingTruncated, UsageError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Clock

SMALL = ImportOptions(size=32)
MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, body: bytes, declared: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if declared is None else declared) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(stored: bytes, declared: int, crc: int = 0, compression: str = "zstd") -> bytes:
    head = struct.pack("<QQQI", START, START, declared, crc) + text(compression)
    return record(0x06, head + struct.pack("<Q", len(stored)) + stored)


def by_hand(path: Path, *records: bytes) -> Path:
    """A file whose records no writer would write: a camera's channel, then these."""
    schema = struct.pack("<H", 1) + text("foxglove.RawImage") + text("protobuf") + struct.pack("<I", 0)
    channel = struct.pack("<HH", 1, 1) + text("/camera") + text("protobuf") + struct.pack("<I", 0)
    footer = record(0x02, struct.pack("<QQI", 0, 0, 0))
    parts = [MAGIC, record(0x01, text("") + text("")), record(0x03, schema), record(0x04, channel), *records]
    path.write_bytes(b"".join([*parts, record(0x0F, struct.pack("<I", 0)), footer, MAGIC]))
    return path


def refused(paths: Path | list[Path], folder: Path, match: str, options: ImportOptions = SMALL) -> str:
    """The import fails with this sentence and leaves nothing behind."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(RecordingImportError, match=match) as caught:
        import_recordings([paths] if isinstance(paths, Path) else paths, folder / "out", options)
    assert sorted(folder.rglob("*")) == before
    return str(caught.value)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return foxglove_file(
        tmp_path_factory.mktemp("good") / "a.mcap", video(12), steady(12), options=MCAPWriteOptions(chunk_size=10_000)
    )


def test_a_missing_topic_lists_those_there_are(tmp_path: Path) -> None:
    file = foxglove_file(tmp_path / "a.mcap", video(3), steady(3), topic="/front/image", actions=[(START, 1)])
    sentence = refused(file, tmp_path, "did you mean '/front/image'", ImportOptions(camera="/front/imag"))
    assert "'/front/image' foxglove.RawImage (camera)" in sentence
    assert "'/action'" in sentence


def test_a_topic_without_pictures(tmp_path: Path) -> None:
    file = foxglove_file(tmp_path / "a.mcap", video(3), steady(3), actions=[(START, 1)])
    refused(file, tmp_path, "'/action' carries .*not pictures; known are", ImportOptions(camera="/action"))


def test_the_camera_gives_no_actions(good: Path, tmp_path: Path) -> None:
    refused(good, tmp_path, "'/camera' is the camera; name the topic of the actions", ImportOptions(actions="/camera"))


def test_several_cameras_are_to_be_chosen_from(tmp_path: Path) -> None:
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context):
        for topic in ("/left", "/right"):
            message = raw_image(START, 4, 4, "rgb8", 12, bytes(48))
            RawImageChannel(topic, context=context).log(message, log_time=START)
    refused(tmp_path / "a.mcap", tmp_path, "2 camera topics; choose one:\n  --camera '/left'\n  --camera '/right'")


def test_no_camera_at_all(tmp_path: Path) -> None:
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context):
        foxglove.Channel("/joints", context=context).log({"q": 1}, log_time=START)
    refused(tmp_path / "a.mcap", tmp_path, "no camera topic that can be imported .*\n  '/joints'")


def test_a_camera_that_never_sent_a_picture(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = OfficialWriter(file)
        writer.start()
        schema = writer.register_schema("foxglove.RawImage", "protobuf", b"")
        writer.register_channel("/camera", "protobuf", schema)
        writer.finish()
    refused(tmp_path / "a.mcap", tmp_path, "has no pictures: there is no message on '/camera'")


def test_mixed_sizes(tmp_path: Path) -> None:
    frames = [*video(3, 32, 32), *video(3, 24, 40)]
    file = foxglove_file(tmp_path / "a.mcap", frames, steady(6))
    refused(file, tmp_path, "mixes picture sizes on '/camera': 32x32 pixels at first, 40x24 in message 3")


def test_mixed_sizes_of_files(tmp_path: Path) -> None:
    files = [foxglove_file(tmp_path / f"{height}.mcap", video(3, height, 32), steady(3)) for height in (32, 24)]
    refused(files, tmp_path, "the recordings mix picture sizes: 32x32 pixels in .*32x24 in .*of their own")


def test_an_unknown_encoding(tmp_path: Path) -> None:
    messages = [("/camera", "sensor_msgs/msg/Image", t, ros_image(t, 4, 4, "nv21", 4, bytes(24))) for t in steady(3)]
    refused(ros_file(tmp_path / "bag", messages), tmp_path, "message 0 on '/camera' has the encoding 'nv21'; known are")


def test_time_going_backwards(tmp_path: Path) -> None:
    times = steady(6)
    times[3] = times[1]
    file = foxglove_file(tmp_path / "a.mcap", video(6), times)
    refused(file, tmp_path, "on '/camera' time goes backwards by 0.100 s at message 3; try the other clock")


def test_a_camera_without_stamps(tmp_path: Path) -> None:
    messages = [("/camera", "sensor_msgs/msg/Image", t, ros_image(0, 4, 4, "rgb8", 12, bytes(48))) for t in steady(3)]
    file = ros_file(tmp_path / "bag", messages)
    refused(file, tmp_path, "no time stamp of its own; use .*--clock log", ImportOptions(clock=Clock.HEADER))


@pytest.mark.parametrize("seconds", [10**12, 10**40])
def test_a_stamp_that_no_clock_shows(tmp_path: Path, seconds: int) -> None:
    file = tmp_path / "a.mcap"
    with file.open("wb") as opened:
        writer = OfficialWriter(opened)
        writer.start()
        channel = writer.register_channel("/c", "json", writer.register_schema("foxglove.RawImage", "jsonschema", b""))
        picture = {"width": 2, "height": 2, "encoding": "mono8", "step": 2, "data": "AAAAAA=="}
        for number, t_ns in enumerate(steady(4)):
            stamp = {"sec": seconds, "nsec": number}
            writer.add_message(channel, t_ns, json.dumps(picture | {"timestamp": stamp}).encode(), t_ns)
        writer.finish()
    refused(
        file, tmp_path, "message 0 on '/c' has a time stamp .* which no clock shows", ImportOptions(clock=Clock.HEADER)
    )
    assert import_recordings([file], tmp_path / "out", SMALL).frames == 4


def bursts(folder: Path, count: int, burst: int) -> Path:
    """A camera of 10 Hz whose recorder writes several pictures at once."""
    return ros_file(
        folder,
        [
            (
                "/camera",
                "sensor_msgs/msg/Image",
                START + number // burst * burst * 100_000_000 + number % burst * 1_000_000,
                ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()),
            )
            for number, (t_ns, frame) in enumerate(zip(steady(count), video(count), strict=True))
        ],
    )


def test_pictures_logged_in_bursts_are_told_of_the_other_clock(tmp_path: Path) -> None:
    file = bursts(tmp_path / "bag", 40, 10)
    sentence = refused(file, tmp_path, "'/camera' was logged in bursts, .* use '--clock header'")
    assert "--hz'" not in sentence
    better = import_recordings([file], tmp_path / "out", ImportOptions(size=32, clock=Clock.HEADER))
    assert (better.frames, better.repeated) == (40, 0)

    poor = import_recordings([file], tmp_path / "poor", ImportOptions(size=32, max_gap_s=2))
    assert any("use '--clock header'" in sentence for sentence in poor.advice)
    assert not any("--clock" in sentence for sentence in better.advice)


def test_a_camera_that_is_too_slow_for_the_rate(tmp_path: Path) -> None:
    slow = foxglove_file(tmp_path / "slow.mcap", video(4), steady(4, hz=0.1))
    refused(slow, tmp_path, "10 s apart, and .* Lower '--hz' to 0.1", ImportOptions(size=32, hz=10))
    days = foxglove_file(tmp_path / "days.mcap", video(4), steady(4, hz=1e-5))
    match = r"4 pictures at 1 Hz: they are 100,000 s apart, .* save them as files and import their folder"
    assert "--hz'" not in refused(days, tmp_path, match, ImportOptions(size=32, hz=1))


def test_too_few_pictures(tmp_path: Path) -> None:
    file = foxglove_file(tmp_path / "a.mcap", video(5), steady(5, hz=0.5))
    refused(file, tmp_path, "no episode of at least 30 frames", ImportOptions(max_gap_s=1, min_frames=30))


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is empty"),
        (b"no recording at all", "is no recording that can be imported: MCAP .*'ffmpeg -i IN OUT.mkv'"),
        (b"\x89MCAP9\r\n", "is no MCAP file: it does not begin with MCAP's eight bytes"),
        (b"#ROSBAG V2.0\n", "a ROS 1 bag; convert it with 'rosbags-convert"),
        (b"SQLite format 3\0", "ROS 2 bag in SQLite; convert it"),
        (zstandard.compress(b"x" * 100), "holds no MCAP file, but is compressed as a whole"),
        (compressed(video(1)[0], "png"), "is a single picture; name the folder that it is in"),
        (compressed(video(1)[0], "webp"), "is a single picture"),
    ],
)
def test_other_files(tmp_path: Path, content: bytes, match: str) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    refused(tmp_path / "a.mcap", tmp_path, f"a.mcap' .*{match}")


def test_what_is_not_there(tmp_path: Path) -> None:
    refused(tmp_path / "nothing.mcap", tmp_path, "there is no .*nothing.mcap")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", tmp_path, "holds no recording: no MCAP .* no pictures .* no LeRobot data set")


def test_a_recording_that_is_named_twice_is_named_in_the_error(good: Path, tmp_path: Path) -> None:
    link = tmp_path / "b.mcap"
    link.symlink_to(good)
    for paths, match in (
        ([good, good], r"^'.*a.mcap' is named twice"),
        ([good, link], r"a.mcap' and '.*b.mcap' are the"),
    ):
        with pytest.raises(UsageError, match=match):
            import_recordings(paths, tmp_path / "out", SMALL)


def test_a_data_set_of_dmbench_is_no_recording(good: Path, tmp_path: Path) -> None:
    dataset = tmp_path / "own set"
    import_recordings([good], dataset, SMALL)
    refused(
        dataset, tmp_path, r"is a data set of dmbench already; train on it with .dmbench train MODEL --data .*own set"
    )


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
    import_recordings([tmp_path / "a.mcap"], tmp_path / "out", ImportOptions(size=32, salvage=True))

    dataset = Dataset.open(tmp_path / "out")
    frames = dataset.video(0)
    assert 5 <= len(frames) < 12
    np.testing.assert_array_equal(frames, video(12)[: len(frames)])


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

    import_recordings([file], tmp_path / "out", ImportOptions(size=32, salvage=True))
    found = Dataset.open(tmp_path / "out").video(0)
    assert 3 <= len(found) <= 6
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
    refused(file, tmp_path, "message 6 on '/camera'")
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


def test_messages_that_are_not_what_they_say(tmp_path: Path) -> None:
    for number, data in enumerate((b"\xff" * 40, b"\x0a\xff\xff\xff\xff\x0f")):
        context = foxglove.Context()
        file = tmp_path / f"{number}.mcap"
        with foxglove.open_mcap(file, context=context):
            schema = foxglove.Schema(name="foxglove.RawImage", encoding="protobuf", data=b"")
            camera = foxglove.Channel("/camera", schema=schema, message_encoding="protobuf", context=context)
            camera.log(data, log_time=START)
        refused(file, tmp_path, "message 0 on '/camera' cannot be decoded as foxglove.RawImage")


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    peaks = []
    for name, count in (("short", 100), ("long", 500)):
        frame = video(1, 96, 96)[0]
        file = foxglove_file(tmp_path / f"{name}.mcap", [frame] * count, steady(count))
        options = ImportOptions(size=32, frames_per_episode=50)
        peaks.append(
            peak_of(lambda file=file, options=options: import_recordings([file], tmp_path / file.stem, options))
        )
    assert peaks[1] < peaks[0] + MIB
    assert peaks[1] < 8 * MIB  # all frames of the long one are 13 MiB


def test_a_topic_s_name_is_no_path(tmp_path: Path) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    file = foxglove_file(folder / "a.mcap", video(4), steady(4), topic="/../../escaped\x1b[31m")
    import_recordings([file], folder / "out", SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["inner"]
    assert sorted(path.name for path in folder.iterdir()) == ["a.mcap", "out"]
    sentence = refused(file, folder / "nowhere", "has no topic", ImportOptions(camera="/x"))
    assert "\x1b" not in sentence


def test_what_stands_there_is_not_touched(good: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("keep")
    with pytest.raises(UsageError, match="is there already and is no data set; name another folder"):
        import_recordings([good], tmp_path / "out", SMALL)
    assert (tmp_path / "out" / "mine").read_text() == "keep"


def test_the_same_command_again_changes_nothing_and_another_is_refused(good: Path, tmp_path: Path) -> None:
    first = import_recordings([good], tmp_path / "out", SMALL)
    made = (tmp_path / "out" / "dataset.json").stat().st_mtime_ns
    assert import_recordings([good], tmp_path / "out", SMALL) == first
    assert (tmp_path / "out" / "dataset.json").stat().st_mtime_ns == made
    with pytest.raises(RecipeMismatch, match="holds a data set of other recordings or options"):
        import_recordings([good], tmp_path / "out", ImportOptions(size=16))


def test_options_that_cannot_be() -> None:
    for wrong in ({"hz": 0.0}, {"hz": float("nan")}, {"size": 2}, {"min_frames": 2}, {"max_gap_s": 0.0}):
        with pytest.raises(InvalidSetting, match=next(iter(wrong))):
            ImportOptions(**wrong)
    with pytest.raises(InvalidSetting, match="more than the 10 frames_per_episode"):
        ImportOptions(min_frames=20, frames_per_episode=10)


def test_limits_can_be_raised(tmp_path: Path) -> None:
    content = record(0x7F, b"\0" * 3 * MIB)
    file = by_hand(tmp_path / "a.mcap", chunk(zstandard.compress(content), len(content)))
    tight = ImportOptions(limits=ImportLimits(chunk_bytes=MIB))
    refused(file, tmp_path, "declares 3 MiB, more than the 1 MiB .*'--max-chunk 4'", tight)
    refused(file, tmp_path, "has no pictures", ImportOptions(limits=ImportLimits(chunk_bytes=4 * MIB)))


def peak_of(run: Callable[[], object]) -> int:
    """The most memory that Python and numpy held while it ran [bytes]."""
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
