"""Messages of ROS 1 in an MCAP file, as ``mcap convert`` keeps them; written by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from storage.foreign import compressed, packed, steady, video

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Clock
from dmotion_bench.storage.imports.ros1_messages import compressed_image, image

ROS1 = get_typestore(Stores.ROS1_NOETIC)
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def message(kind: str, t_ns: int, **fields: Any) -> bytes:
    """A message with a header, as rosbags writes it."""
    stamp = ROS1.types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    header = ROS1.types["std_msgs/msg/Header"](seq=7, stamp=stamp, frame_id="camèra")
    return bytes(ROS1.serialize_ros1(ROS1.types[kind](header=header, **fields), kind))


def raw(t_ns: int, frame: np.ndarray, encoding: str = "bgr8") -> bytes:
    data, step = packed(frame, encoding)
    pixels = np.frombuffer(data, np.uint8)
    height, width = frame.shape[:2]
    return message(IMAGE, t_ns, height=height, width=width, encoding=encoding, is_bigendian=0, step=step, data=pixels)


def file_of(path: Path, kind: str, messages: Sequence[bytes], times: Sequence[int]) -> Path:
    """An MCAP file with a camera, and a topic of twists in which nothing is."""
    with path.open("wb") as opened:
        writer = Writer(opened)
        writer.start(profile="ros1")
        schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", ROS1.generate_msgdef(kind)[0].encode())
        camera = writer.register_channel("/camera", "ros1", schema)
        twist = writer.register_schema("geometry_msgs/Twist", "ros1msg", b"")
        commands = writer.register_channel("/cmd_vel", "ros1", twist)
        for t_ns, data in zip(times, messages, strict=True):
            writer.add_message(camera, t_ns, data, t_ns)
            writer.add_message(commands, t_ns, bytes(48), t_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
@pytest.mark.parametrize("clock", list(Clock))
def test_raw_pictures(tmp_path: Path, encoding: str, clock: Clock) -> None:
    frames, times = video(5), steady(5)
    messages = [raw(t_ns, frame, encoding) for t_ns, frame in zip(times, frames, strict=True)]
    file = file_of(tmp_path / "a.mcap", IMAGE, messages, times)
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=32, clock=clock))
    np.testing.assert_array_equal(Dataset.open(report.path).video(0), frames)


def test_compressed_pictures(tmp_path: Path) -> None:
    frames, times = video(5), steady(5)
    files = [np.frombuffer(compressed(frame, "png"), np.uint8) for frame in frames]
    messages = [message(COMPRESSED, t_ns, format="png", data=data) for t_ns, data in zip(times, files, strict=True)]
    file = file_of(tmp_path / "a.mcap", COMPRESSED, messages, times)
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=32))
    np.testing.assert_array_equal(Dataset.open(report.path).video(0), frames)


def test_the_fields_are_those_that_were_written() -> None:
    found = image(raw(1_700_000_000_123_456_789, video(1, 4, 6)[0]))
    pixels = found.pop("data")
    assert found == {
        "header": {"stamp": {"sec": 1_700_000_000, "nsec": 123_456_789}, "frame_id": "camèra"},
        "height": 4,
        "width": 6,
        "encoding": "bgr8",
        "is_bigendian": 0,
        "step": 18,
    }
    np.testing.assert_array_equal(np.frombuffer(pixels, np.uint8).reshape(4, 6, 3)[..., ::-1], video(1, 4, 6)[0])


def test_bytes_that_are_no_message_are_refused() -> None:
    whole = raw(0, video(1, 2, 2)[0])
    for length in range(len(whole)):
        with pytest.raises(ValueError, match="bytes are missing at its end"):
            image(whole[:length])
    with pytest.raises(ValueError, match="3 bytes are left over"):
        image(whole + b"abc")
    with pytest.raises(ValueError, match=r"4,294,967,\d+ bytes are missing"):
        compressed_image(bytes(12) + b"\xff" * 4 + b"png")


def test_a_damaged_message_and_actions_are_sentences(tmp_path: Path) -> None:
    times = steady(3)
    messages = [raw(t_ns, frame) for t_ns, frame in zip(times, video(3), strict=True)]
    file = file_of(tmp_path / "a.mcap", IMAGE, [*messages[:2], messages[2][:-1]], times)
    with pytest.raises(RecordingImportError, match="message 2 on '/camera' cannot be decoded as sensor_msgs/Image: 1 "):
        import_recordings([file], tmp_path / "out", ImportOptions(size=32))
    whole = file_of(tmp_path / "b.mcap", IMAGE, messages, times)
    options = [ImportOptions(size=32, actions="/cmd_vel", action_fields=fields) for fields in ((), ("linear.x",))]
    for one in options:
        with pytest.raises(RecordingImportError, match=r"Of ROS 1 only the cameras can be read: make .* 'rosbags-conv"):
            import_recordings([whole], tmp_path / "out", one)
