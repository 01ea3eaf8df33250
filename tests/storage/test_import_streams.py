"""Video over topics: foxglove.CompressedVideo, ROS 2's, and packets in sensor_msgs/CompressedImage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import foxglove
import numpy as np
import pytest
from foxglove.channels import CompressedVideoChannel, RawImageChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import CompressedVideo, Timestamp
from rosbags.typesys import get_types_from_msg
from storage.foreign import ROS, START, raw_image, ros_file, ros_header, ros_image, steady, video
from storage.foreign_video import Frames, moving, packets

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.recording import Clock

OPTIONS = ImportOptions(size=48)
H264 = ("libx264rgb", "rgb24", {"qp": "0", "g": "10", "tune": "zerolatency"})
LOSSLESS_H265 = "lossless=1:keyint=10:repeat-headers=1:log-level=none"
STREAMS = {
    "h264": H264,
    "h265": ("libx265", "gbrp", {"x265-params": f"{LOSSLESS_H265}:bframes=0"}),
    "vp9": ("libvpx-vp9", "gbrp", {"lossless": "1", "g": "10", "lag-in-frames": "0"}),
}
FFMPEG_PACKET = """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""
FOXGLOVE_VIDEO = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
for name, text in (
    ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", FFMPEG_PACKET),
    ("foxglove_msgs/msg/CompressedVideo", FOXGLOVE_VIDEO),
):
    ROS.register(get_types_from_msg(text, name))


def square(count: int) -> Frames:
    return moving(count, 48, 48)


def foxglove_stream(
    path: Path,
    sent: Sequence[bytes],
    times: Sequence[int],
    form: str = "h264",
    late: int = 0,
    options: MCAPWriteOptions | None = None,
) -> Path:
    """foxglove.CompressedVideo in protobuf, logged some time after the picture was taken."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context, writer_options=options):
        camera = CompressedVideoChannel("/video", context=context)
        for data, t_ns in zip(sent, times, strict=True):
            stamp = Timestamp(sec=t_ns // 10**9, nsec=t_ns % 10**9)
            message = CompressedVideo(timestamp=stamp, frame_id="camera", data=data, format=form)
            camera.log(message, log_time=t_ns + late)
    return path


def imported(file: Path, options: ImportOptions = OPTIONS) -> tuple[ImportReport, Dataset]:
    report = import_recordings([file], file.parent / "out", options)
    return report, Dataset.open(report.path)


def refused(file: Path, match: str, options: ImportOptions = OPTIONS) -> str:
    with pytest.raises(RecordingImportError, match=match) as caught:
        import_recordings([file], file.parent / "out", options)
    assert not (file.parent / "out").exists()
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("form", STREAMS)
def test_foxglove_video(tmp_path: Path, form: str) -> None:
    frames = square(25)
    file = foxglove_stream(tmp_path / "a.mcap", packets(frames, *STREAMS[form]), steady(25), form)
    report, dataset = imported(file)
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert (report.source_frames, report.unreadable) == (25, 0)
    assert dataset.rows[0].start_ns == START
    assert dataset.recipe.parameters["camera"] == "/video"


@pytest.mark.slow
def test_av1_over_a_topic_is_what_the_encoder_meant(tmp_path: Path) -> None:
    frames = square(20)
    settings = {"preset": "10", "crf": "5", "svtav1-params": "pred-struct=1:keyint=10"}
    _, dataset = imported(
        foxglove_stream(tmp_path / "a.mcap", packets(frames, "libsvtav1", "yuv420p", settings), steady(20), "av1")
    )
    difference = np.abs(dataset.video(0).astype(int) - frames)
    assert difference.mean() < 12  # its colours are halved; noise costs most
    others = np.abs(dataset.video(0)[:-5].astype(int) - frames[5:]).mean()
    assert difference.mean() < others / 1.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("foxglove_msgs/msg/CompressedVideo", {"frame_id": "camera", "format": "h264"}),
        (
            "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
            {
                "width": 48,
                "height": 48,
                "encoding": "h264;rgb24;bgr8;bgr8",
                "pts": 7,
                "flags": 1,
                "is_bigendian": False,
            },
        ),
        (
            "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
            {"width": 48, "height": 48, "encoding": "libx264", "pts": 7, "flags": 1, "is_bigendian": False},
        ),
        ("sensor_msgs/msg/CompressedImage", {"format": "h264"}),
    ],
)
def test_ros_video(tmp_path: Path, kind: str, fields: dict[str, Any]) -> None:
    frames = square(12)
    messages = []
    for t_ns, data in zip(steady(12), packets(frames, *H264), strict=True):
        header = ros_header(t_ns)
        when = {"timestamp": header.stamp} if "foxglove" in kind else {"header": header}
        messages.append(("/video", kind, t_ns, {**when, **fields, "data": np.frombuffer(data, np.uint8)}))
        messages.append(("/action", "std_msgs/msg/Int32", t_ns, {"data": len(messages) % 4}))
    options = ImportOptions(size=48, actions="/action", clock=Clock.HEADER)
    _, dataset = imported(ros_file(tmp_path / "bag", messages), options)
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert [dataset.spec.actions.names[number] for number in dataset.states(0).actions] == ["1", "3"] * 5 + ["1"]


def test_a_recording_may_begin_in_the_middle_of_a_video(tmp_path: Path) -> None:
    frames = square(30)
    sent, times = packets(frames, *H264), steady(30)
    report, dataset = imported(foxglove_stream(tmp_path / "a.mcap", sent[4:], times[4:]))
    np.testing.assert_array_equal(dataset.video(0), frames[10:])  # the next key frame
    assert dataset.rows[0].start_ns == times[10]
    assert (report.source_frames, report.unreadable) == (20, 0)


def test_messages_that_were_lost_are_told_of(tmp_path: Path) -> None:
    sent, times = packets(square(30), *H264), steady(30)
    kept = [place for place in range(30) if place not in (4, 10, 25, 26)]  # 10 is a key frame
    report, _ = imported(
        foxglove_stream(tmp_path / "a.mcap", [sent[place] for place in kept], [times[place] for place in kept])
    )
    start = "messages on '/video' were lost before they were recorded, in 3 places: the pictures after them"
    assert any(told.startswith(start) for told in report.advice)
    (tmp_path / "whole").mkdir()
    whole, _ = imported(foxglove_stream(tmp_path / "whole/b.mcap", sent, times))
    assert not any("were lost" in told for told in whole.advice)


def test_pictures_that_come_in_another_order_stand_at_their_own_times(tmp_path: Path) -> None:
    frames, times = square(24), steady(24)
    sent = packets(frames, "libx265", "gbrp", {"x265-params": f"{LOSSLESS_H265}:bframes=2:b-adapt=0"})
    order = []  # of the packets: that of their pictures, as a decoder tells
    with_numbers = av.CodecContext.create("hevc", "r")
    for number, data in enumerate(sent):
        packet = av.Packet(data)
        packet.pts = number
        order += [frame.pts for frame in with_numbers.decode(packet)]  # type: ignore[attr-defined]
    order += [frame.pts for frame in with_numbers.decode(None)]  # type: ignore[attr-defined]
    stamps = [0] * 24
    for place, number in enumerate(order):
        stamps[number] = times[place]
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context):
        camera = CompressedVideoChannel("/video", context=context)
        for data, t_ns, logged in zip(sent, stamps, times, strict=True):
            stamp = Timestamp(sec=t_ns // 10**9, nsec=t_ns % 10**9)
            message = CompressedVideo(timestamp=stamp, frame_id="camera", data=data, format="h265")
            camera.log(message, log_time=logged)
    assert order != sorted(order)
    _, dataset = imported(tmp_path / "a.mcap", ImportOptions(size=48, clock=Clock.HEADER))
    np.testing.assert_array_equal(dataset.video(0), frames)


@pytest.mark.slow
def test_a_damaged_packet(tmp_path: Path) -> None:
    frames = square(40)
    sent = packets(frames, *H264)
    sent[14] = sent[14][:20] + bytes(len(sent[14]) - 20)
    file = foxglove_stream(tmp_path / "a.mcap", sent, steady(40))
    refused(file, r"message 14 on '/video' is damaged: .*'--salvage'")
    report, dataset = imported(file, ImportOptions(size=48, salvage=True))
    assert report.unreadable == 6  # up to the next key frame
    kept = np.concatenate([dataset.video(episode) for episode in range(len(dataset))])
    np.testing.assert_array_equal(kept, frames[[*range(14), *range(20, 40)]])


@pytest.mark.slow
def test_a_cut_file_is_told_of(tmp_path: Path) -> None:
    frames = square(40)
    small = MCAPWriteOptions(chunk_size=1000)
    file = foxglove_stream(tmp_path / "a.mcap", packets(frames, *H264), steady(40), options=small)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    refused(file, "is cut off: .*'--salvage'")
    report, dataset = imported(file, ImportOptions(size=48, salvage=True))
    kept = np.concatenate([dataset.video(episode) for episode in range(len(dataset))])
    assert 10 <= len(kept) < 40
    np.testing.assert_array_equal(kept, frames[: len(kept)])
    assert any(f"a.mcap' is cut off or damaged after {len(kept)} pictures (" in told for told in report.advice)


@pytest.mark.slow
def test_a_format_that_is_no_video(tmp_path: Path) -> None:
    file = foxglove_stream(tmp_path / "a.mcap", [b"x" * 20] * 3, steady(3), "theora")
    refused(file, "its format is 'theora'; known are h264, hevc, av1, vp9, vp8")
    nothing = foxglove_stream(tmp_path / "b.mcap", [b"x" * 20] * 3, steady(3), "h264")
    refused(nothing, r"no message on '/video' gives a picture\. A video is decoded .* headers with it .*repeat them")
    empty = foxglove_stream(tmp_path / "c.mcap", [b""] * 3, steady(3), "h264")
    refused(empty, "no message on '/video' gives a picture")


@pytest.mark.slow
def test_video_that_is_too_large_or_changes(tmp_path: Path) -> None:
    file = foxglove_stream(tmp_path / "a.mcap", packets(square(5), *H264), steady(5))
    refused(file, "is 48x48 pixels large|gives a picture", ImportOptions(limits=ImportLimits(pixels=1000)))
    sent = packets(square(5), *H264) + packets(moving(5, 32, 48), *H264)
    changed = foxglove_stream(tmp_path / "b.mcap", sent, steady(10))
    refused(changed, "mixes picture sizes on '/video': 48x48 pixels at first, 48x32 in message 5")


def camera_beside(path: Path, *encodings: str) -> Path:
    """Cameras of several encodings, each a topic."""
    return ros_file(
        path,
        [
            (f"/{encoding}", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 4, 4, encoding, 12, frame.tobytes()))
            for t_ns, frame in zip(steady(4), video(4, 4, 4), strict=True)
            for encoding in encodings
        ],
    )


def test_depth_beside_colour_is_no_choice(tmp_path: Path) -> None:
    report, dataset = imported(camera_beside(tmp_path / "bag", "16UC1", "rgb8", "32FC1"), ImportOptions(size=8))
    assert dataset.recipe.parameters["camera"] == "/rgb8"
    assert report.source_frames == 4

    several = refused_bag(tmp_path / "several", "16UC1", "rgb8", "bgr8")
    assert "has 2 camera topics; choose one:\n  --camera '/bgr8'\n  --camera '/rgb8'\n  not '/16UC1': it has" in several
    assert "depth is no picture" in several
    none = refused_bag(tmp_path / "none", "16UC1", "32FC1")
    assert "has no camera that can be imported:\n  not '/16UC1'" in none


def refused_bag(folder: Path, *encodings: str) -> str:
    with pytest.raises(RecordingImportError) as caught:
        import_recordings([camera_beside(folder, *encodings)], folder.parent / "nothing", ImportOptions(size=8))
    assert not (folder.parent / "nothing").exists()
    return str(caught.value)


def test_a_silent_camera_is_no_choice(tmp_path: Path) -> None:
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context):
        camera = RawImageChannel("/loud", context=context)
        silent = RawImageChannel("/silent", context=context)
        assert silent.topic() == "/silent"
        for t_ns, frame in zip(steady(4), video(4), strict=True):
            camera.log(raw_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()), log_time=t_ns)
    _, dataset = imported(tmp_path / "a.mcap", ImportOptions(size=32))
    assert dataset.recipe.parameters["camera"] == "/loud"
