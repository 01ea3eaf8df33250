"""Bad recordings: a sentence that helps, bounded memory, and nothing left behind."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import foxglove
import pytest
import zstandard
from foxglove.channels import RawImageChannel
from mcap.writer import Writer as OfficialWriter
from storage.foreign import (
    START,
    compressed,
    foxglove_file,
    raw_image,
    ros_file,
    ros_image,
    steady,
    video,
)
from storage.hand_made import SMALL, by_hand, chunk, peak_of, record, refused
from walking_square import record_walks

from dmotion_bench.errors import InvalidSetting, RecipeMismatch, UsageError
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Clock

LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"


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
    refused(
        files,
        tmp_path,
        "the recordings mix pictures of different proportions: 32x32 pixels in .*32x24 in .*of their own, or",
    )


def test_an_unknown_encoding(tmp_path: Path) -> None:
    messages = [("/camera", "sensor_msgs/msg/Image", t, ros_image(t, 4, 4, "nv21", 4, bytes(24))) for t in steady(3)]
    refused(ros_file(tmp_path / "bag", messages), tmp_path, "message 0 on '/camera' has the encoding 'nv21'; known are")


def test_video_of_ros_1_is_told_how_to_be_converted(tmp_path: Path) -> None:
    """``mcap convert`` keeps its messages as they are, so that the file looks like one that can be read."""
    file = tmp_path / "a.mcap"
    with file.open("wb") as opened:
        writer = OfficialWriter(opened)
        writer.start(profile="ros1")
        schema = writer.register_schema("foxglove_msgs/CompressedVideo", "ros1msg", b"")
        channel = writer.register_channel("/c", "ros1", schema)
        writer.add_message(channel, START, b"\0" * 40, START)
        writer.finish()
    refused(
        file, tmp_path, "'/c' carries foxglove_msgs/CompressedVideo written as 'ros1'; .* 'rosbags-convert --src BAG"
    )


def test_time_going_backwards(tmp_path: Path) -> None:
    """Too far: all messages would have to wait for the last one."""
    times = steady(6)
    file = foxglove_file(tmp_path / "a.mcap", video(6), [*times[1:], times[0]])
    options = ImportOptions(limits=ImportLimits(message_bytes=10_000))
    refused(file, tmp_path, "on '/camera' time goes backwards by 0.500 s at message 5; try the other clock", options)


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
        (LFS_POINTER, "is a pointer of Git LFS and not the file itself; fetch the files with 'git lfs pull'"),
    ],
)
def test_other_files(tmp_path: Path, content: bytes, match: str) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    refused(tmp_path / "a.mcap", tmp_path, f"a.mcap' .*{match}")


def test_pictures_in_one_file_are_a_video_without_container(tmp_path: Path) -> None:
    (tmp_path / "a.mjpeg").write_bytes(2 * compressed(video(1)[0], "jpeg"))
    refused(tmp_path / "a.mjpeg", tmp_path, "a.mjpeg' is no recording .*'ffmpeg -i IN OUT.mkv'")


@pytest.mark.parametrize("name", ["a.mcap", "a.mp4", "a.h5", "1.png", "b.parquet"])
def test_files_that_were_not_fetched(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "clone"
    folder.mkdir()
    (folder / name).write_bytes(LFS_POINTER)
    found = folder / name if name == "b.parquet" else folder
    refused(found, tmp_path, f"{name}' is a pointer of Git LFS .* 'git lfs pull'")


@pytest.mark.parametrize(
    ("name", "holds"),
    [("a.npz", "NumPy"), ("a.npy", "NumPy"), ("a.pkl", "pickled Python"), ("x-train.tfrecord-00000-of-1", "TFRecord")],
)
def test_arrays_are_told_how_to_become_recordings(tmp_path: Path, name: str, holds: str) -> None:
    folder = tmp_path / "set"
    (folder / "inside").mkdir(parents=True)
    (folder / "inside" / name).write_bytes(b"PK\x03\x04")
    told = refused(
        folder, tmp_path, f"'inside/{name}' in it holds {holds} .* a format that is not read: write the pictures"
    )
    alone = refused(
        folder / "inside" / name, tmp_path, f"{name}' holds {holds} .* a format that is not read: write the"
    )
    assert "ffmpeg" not in told + alone


def test_times_that_cannot_be_told_are_refused(good: Path, tmp_path: Path) -> None:
    for options, match in (
        (ImportOptions(source_hz=10), "'--source-hz' is for pictures, HDF5 files and videos; .* leave it out"),
        (ImportOptions(clock=Clock.HEADER), "'--clock header' is for MCAP files; .* leave it out"),
    ):
        folder = tmp_path / "pictures"
        folder.mkdir(exist_ok=True)
        for number, frame in enumerate(video(4)):
            (folder / f"{number}.png").write_bytes(compressed(frame, "png"))
        alone = good if options.source_hz else folder
        for run in (import_recordings, import_fleet):
            with pytest.raises(InvalidSetting, match=match):
                run([alone], tmp_path / "out", options)


def test_a_device_or_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    refused(Path("/dev/null"), tmp_path, "'/dev/null' is no ordinary file; save what comes out of it")


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


@pytest.mark.slow
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
    other = dataclasses.replace(SMALL, size=16, seed=3, salvage=True, max_gap_s=9.0)
    said = (
        f"'--size' is {SMALL.size} there and 16 here; '--max-gap' is left out there and 9.0 here; '--salvage' is left "
        "out there and given here; '--seed' is 0 there and 3 here; name another folder"
    )
    with pytest.raises(RecipeMismatch, match=f"holds an import with other options: {re.escape(said)}"):
        import_recordings([good], tmp_path / "out", other)


def test_other_recordings_in_the_same_folder_are_refused_by_name(good: Path, tmp_path: Path) -> None:
    second = foxglove_file(tmp_path / "second.mcap", video(5), steady(5))
    import_recordings([good], tmp_path / "out", SMALL)
    import_recordings([good, second], tmp_path / "both", SMALL)
    for given, place, said in (
        ([good, second], "out", "import of other recordings, which lacks 'second.mcap'"),
        ([second], "both", f"import of other recordings, which has {good.name!r}"),
        ([second, good], "both", "import of these recordings in another order"),
    ):
        with pytest.raises(RecipeMismatch, match=said):
            import_recordings(given, tmp_path / place, SMALL)


def test_an_import_into_a_recorded_data_set_is_refused(good: Path, tmp_path: Path) -> None:
    record_walks(tmp_path / "walks", episodes=2)
    with pytest.raises(RecipeMismatch, match="holds a data set recorded in 'walk'; name another folder"):
        import_recordings([good], tmp_path / "walks", SMALL)


def test_options_that_cannot_be() -> None:
    for wrong in ({"hz": 0.0}, {"hz": float("nan")}, {"size": 2}, {"min_frames": 2}, {"max_gap_s": 0.0}):
        name = next(iter(wrong)).removesuffix("_s").replace("_", "-")
        with pytest.raises(InvalidSetting, match=f"'--{name}' is "):
            ImportOptions(**wrong)
    with pytest.raises(InvalidSetting, match="longer episodes than '--frames-per-episode' 10 are cut"):
        ImportOptions(min_frames=20, frames_per_episode=10)


def test_limits_can_be_raised(tmp_path: Path) -> None:
    content = record(0x7F, b"\0" * 3 * MIB)
    file = by_hand(tmp_path / "a.mcap", chunk(zstandard.compress(content), len(content)))
    tight = ImportOptions(limits=ImportLimits(chunk_bytes=MIB))
    refused(file, tmp_path, "declares 3 MiB, more than the 1 MiB .*'--max-chunk 4'", tight)
    refused(file, tmp_path, "has no pictures", ImportOptions(limits=ImportLimits(chunk_bytes=4 * MIB)))
