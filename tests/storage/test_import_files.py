"""What other implementations have written comes in with the pixels and times that it has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zstandard
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from rosbags.rosbag2 import CompressionMode
from storage.foreign import (
    START,
    compressed,
    foxglove_compressed_file,
    foxglove_file,
    foxglove_json_file,
    packed,
    ros_file,
    ros_header,
    ros_image,
    steady,
    video,
)

from dmotion_bench.errors import LabelsNotAvailable, RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Clock

SMALL = ImportOptions(size=32)


def imported(file: Path, folder: Path, options: ImportOptions = SMALL) -> Dataset:
    import_recordings([file], folder / "out", options)
    return Dataset.open(folder / "out")


def grey(frames: np.ndarray) -> np.ndarray:
    return np.repeat(frames[..., 1:2], 3, axis=3)


ENCODINGS = ["rgb8", "bgr8", "rgba8", "bgra8", "mono8", "mono16"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_foxglove_protobuf(tmp_path: Path, encoding: str) -> None:
    frames = video(7)
    dataset = imported(foxglove_file(tmp_path / "a.mcap", frames, steady(7), encoding=encoding), tmp_path)

    expected = grey(frames) if encoding.startswith("mono") else frames
    np.testing.assert_array_equal(dataset.video(0), expected)
    assert dataset.spec.step_ns == 100_000_000
    assert dataset.spec.actions is None
    assert dataset.spec.objects == ()
    assert not (dataset.path / "labels").exists()
    with pytest.raises(LabelsNotAvailable):
        dataset.labels(0)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_ros_cdr(tmp_path: Path, encoding: str) -> None:
    frames = video(5)
    messages = [
        ("/camera/image_raw", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 32, 32, encoding, step, data))
        for t_ns, frame in zip(steady(5), frames, strict=True)
        for data, step in [packed(frame, encoding)]
    ]
    dataset = imported(ros_file(tmp_path / "bag", messages), tmp_path)

    expected = grey(frames) if encoding.startswith("mono") else frames
    np.testing.assert_array_equal(dataset.video(0), expected)
    assert dataset.recipe.parameters["camera"] == "/camera/image_raw"


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_bags_that_rosbag2_has_compressed(tmp_path: Path, mode: CompressionMode) -> None:
    frames = video(6)
    messages: list[tuple[str, str, int, dict[str, object]]] = []
    for t_ns, frame in zip(steady(6), frames, strict=True):
        picture = ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes())
        messages += [("/camera", "sensor_msgs/msg/Image", t_ns, picture)]
        messages += [("/action", "std_msgs/msg/String", t_ns, {"data": f"push {len(messages) % 4}"})]
    file = ros_file(tmp_path / "bag", messages, mode)
    assert file.name == ("bag.mcap.zstd" if mode is CompressionMode.FILE else "bag.mcap")
    for path, out in ((file, "file"), (file.parent, "folder")):
        report = import_recordings([path], tmp_path / out, ImportOptions(size=32, actions="/action"))
        dataset = Dataset.open(report.path)
        np.testing.assert_array_equal(dataset.video(0), frames)
        assert [dataset.spec.actions.names[number] for number in dataset.states(0).actions] == [
            "push 1",
            "push 3",
        ] * 2 + ["push 1"]


def test_a_file_that_was_compressed_as_a_whole_in_several_parts(tmp_path: Path) -> None:
    frames = video(5)
    whole = foxglove_file(tmp_path / "a.mcap", frames, steady(5)).read_bytes()
    half = len(whole) // 2
    (tmp_path / "a.mcap.zst").write_bytes(zstandard.compress(whole[:half]) + zstandard.compress(whole[half:]))
    np.testing.assert_array_equal(imported(tmp_path / "a.mcap.zst", tmp_path).video(0), frames)


def test_a_bag_is_named_by_its_folder(tmp_path: Path) -> None:
    frames = video(5)
    messages = [
        ("/camera", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()))
        for t_ns, frame in zip(steady(5), frames, strict=True)
    ]
    ros_file(tmp_path / "bag", messages)
    np.testing.assert_array_equal(imported(tmp_path / "bag", tmp_path).video(0), frames)


def test_json(tmp_path: Path) -> None:
    frames = video(4)
    dataset = imported(foxglove_json_file(tmp_path / "a.mcap", frames, steady(4)), tmp_path)
    np.testing.assert_array_equal(dataset.video(0), frames)


@pytest.mark.parametrize(("kind", "options"), [("png", {}), ("jpeg", {"quality": 90}), ("webp", {"lossless": True})])
def test_compressed_pictures(tmp_path: Path, kind: str, options: dict[str, object]) -> None:
    smooth = np.linspace(0, 200, 32, dtype=np.uint8)[None, :, None] + np.zeros((32, 1, 3), np.uint8)
    frames = np.stack([smooth + 10 * number for number in range(4)])
    pictures = [compressed(frame, kind, **options) for frame in frames]
    dataset = imported(foxglove_compressed_file(tmp_path / "a.mcap", pictures, steady(4), kind), tmp_path)

    difference = np.abs(dataset.video(0).astype(int) - frames)
    assert difference.max() <= (3 if kind == "jpeg" else 0)


def test_ros_compressed_pictures(tmp_path: Path) -> None:
    frames = video(4)
    messages = [
        (
            "/camera/compressed",
            "sensor_msgs/msg/CompressedImage",
            t_ns,
            {
                "header": ros_header(t_ns),
                "format": "rgb8; png compressed bgr8",
                "data": np.frombuffer(compressed(frame, "png"), np.uint8),
            },
        )
        for t_ns, frame in zip(steady(4), frames, strict=True)
    ]
    np.testing.assert_array_equal(imported(ros_file(tmp_path / "bag", messages), tmp_path).video(0), frames)


@pytest.mark.parametrize(
    "options",
    [
        MCAPWriteOptions(compression=MCAPCompression.Lz4),
        MCAPWriteOptions(compression=None),
        MCAPWriteOptions(use_chunks=False),
        MCAPWriteOptions(chunk_size=4096, repeat_channels=False, repeat_schemas=False, emit_chunk_indexes=False),
    ],
    ids=["lz4", "uncompressed", "no chunks", "no summary"],
)
def test_every_way_to_write_mcap(tmp_path: Path, options: MCAPWriteOptions) -> None:
    frames = video(5)
    dataset = imported(foxglove_file(tmp_path / "a.mcap", frames, steady(5), options=options), tmp_path)
    np.testing.assert_array_equal(dataset.video(0), frames)


def test_a_row_may_be_longer_than_its_pixels(tmp_path: Path) -> None:
    frames = video(4)
    padded = np.zeros((4, 32, 100), np.uint8)
    padded[:, :, :96] = frames.reshape(4, 32, 96)
    messages = [
        ("/camera", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 32, 32, "rgb8", 100, rows.tobytes()))
        for t_ns, rows in zip(steady(4), padded, strict=True)
    ]
    np.testing.assert_array_equal(imported(ros_file(tmp_path / "bag", messages), tmp_path).video(0), frames)


def test_a_faster_camera_is_thinned_out(tmp_path: Path) -> None:
    frames = video(31)
    dataset = imported(foxglove_file(tmp_path / "a.mcap", frames, steady(31, hz=30)), tmp_path)
    np.testing.assert_array_equal(dataset.video(0), frames[::3])
    assert dataset.rows[0].start_ns == START


def test_a_gap_and_the_longest_length_make_episodes(tmp_path: Path) -> None:
    frames, times = video(20), steady(20)
    times = times[:8] + [t_ns + 5_000_000_000 for t_ns in times[8:]]
    options = ImportOptions(size=32, frames_per_episode=6)
    dataset = imported(foxglove_file(tmp_path / "a.mcap", frames, times), tmp_path, options)

    assert dataset.lengths.tolist() == [4, 4, 6, 6]
    np.testing.assert_array_equal(np.concatenate([dataset.video(episode) for episode in range(4)]), frames)
    assert dataset.rows[2].start_ns == times[8]


def test_the_header_s_clock(tmp_path: Path) -> None:
    frames, times = video(8), steady(8)
    late = [t_ns + 40_000_000 * (number % 2) for number, t_ns in enumerate(times)]  # logged with a jitter
    messages = [
        ("/camera", "sensor_msgs/msg/Image", logged, ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()))
        for logged, t_ns, frame in zip(late, times, frames, strict=True)
    ]
    file = ros_file(tmp_path / "bag", messages)
    dataset = imported(file, tmp_path, ImportOptions(size=32, clock=Clock.HEADER))
    np.testing.assert_array_equal(dataset.video(0), frames)


def test_messages_that_were_written_out_of_order_are_sorted_by_their_times(tmp_path: Path) -> None:
    frames, times = video(12), steady(12)
    order = [1, 0, 2, 5, 4, 3, 6, 7, 9, 10, 11, 8]
    file = foxglove_file(
        tmp_path / "a.mcap",
        frames[order],
        [times[number] for number in order],
        actions=[(times[number], number % 3) for number in reversed(order)],
    )
    dataset = imported(file, tmp_path, ImportOptions(size=32, actions="/action"))
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert dataset.states(0).actions.tolist() == [number % 3 for number in range(11)]
    half = imported(file, tmp_path / "half", ImportOptions(size=32, hz=5))
    np.testing.assert_array_equal(half.video(0), frames[::2])
    advice = import_recordings([file], tmp_path / "half/out", ImportOptions(size=32, hz=5)).advice
    assert any(one.startswith("4 of 12 messages on '/camera' were written after a later one, by") for one in advice)


def test_a_clock_that_was_set_back_does_not_mix_pictures_of_two_moments(tmp_path: Path) -> None:
    """Pictures 6 to 11 were recorded at the times of 3 to 8, and their camera knows better."""
    frames, taken = video(12), steady(12)
    logged = [*taken[:6], *(t_ns + 7_000_000 for t_ns in taken[3:9])]
    messages = [
        ("/camera", "sensor_msgs/msg/Image", at, ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()))
        for at, t_ns, frame in zip(logged, taken, frames, strict=True)
    ]
    commands = [("/action", "std_msgs/msg/Int32", at + 1, {"data": number}) for number, at in enumerate(logged)]
    file = ros_file(tmp_path / "bag", [one for pair in zip(messages, commands, strict=True) for one in pair])
    for options, way_out in (
        (ImportOptions(size=32), "so the recorder's clock was set back; use '--clock header'."),
        (ImportOptions(size=32, actions="/action"), "leave '--actions' out and use '--clock header'."),
    ):
        with pytest.raises(RecordingImportError, match=r"go back by 0\.193 s at message 6, ") as caught:
            import_recordings([file], tmp_path / "out", options)
        assert str(caught.value).endswith(way_out)
    dataset = imported(file, tmp_path, ImportOptions(size=32, clock=Clock.HEADER))
    np.testing.assert_array_equal(dataset.video(0), frames)


@pytest.mark.parametrize(("robots", "told"), [(("a", "b"), True), (("a", ""), False)])
def test_two_robots_on_one_topic_are_told_of(tmp_path: Path, robots: tuple[str, str], told: bool) -> None:
    messages = [
        ("/c", "sensor_msgs/msg/Image", t, ros_image(t, 32, 32, "rgb8", 96, frame.tobytes(), robots[number % 2]))
        for number, (t, frame) in enumerate(zip(steady(8), video(8), strict=True))
    ]
    advice = import_recordings([ros_file(tmp_path / "bag", messages)], tmp_path / "out", SMALL).advice
    assert any("several values of 'frame_id' ('a', 'b')" in one for one in advice) is told
    assert any("frame_id" in one for one in advice) is told


def test_many_files_are_one_data_set(tmp_path: Path) -> None:
    frames = video(12)
    folder = tmp_path / "recordings"
    folder.mkdir()
    for number, name in enumerate(("run_2.mcap", "run_10.mcap", "run_1.mcap")):
        foxglove_file(folder / name, frames[4 * number : 4 * number + 4], steady(4))
    dataset = imported(folder, tmp_path)

    order = [8, 0, 4]  # run_1, run_2, run_10
    for episode, first in enumerate(order):
        np.testing.assert_array_equal(dataset.video(episode), frames[first : first + 4])
    assert [dataset.recipe.parameters[f"file_{number}"] for number in range(3)] == [
        "run_1.mcap",
        "run_2.mcap",
        "run_10.mcap",
    ]


def test_a_copy_of_a_recording_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for number in range(3):
        foxglove_file(folder / f"{number}.mcap", video(4, seed=number % 2), steady(4))
    with pytest.raises(RecordingImportError, match=r"0\.mcap' and '.*2\.mcap' are the same recording; leave one out"):
        imported(folder, tmp_path)


def test_a_folder_of_folders_holds_the_recordings_of_each(tmp_path: Path) -> None:
    frames = video(12)
    for number, name in enumerate(("day_2", "day_10", "day_1")):
        folder = tmp_path / "recordings" / name
        folder.mkdir(parents=True)
        foxglove_file(folder / "run.mcap", frames[4 * number : 4 * number + 4], steady(4))
    dataset = imported(tmp_path / "recordings", tmp_path)

    assert len(dataset) == 3
    for episode, first in enumerate([8, 0, 4]):  # day_1, day_2, day_10
        np.testing.assert_array_equal(dataset.video(episode), frames[first : first + 4])


def test_the_same_files_make_the_same_bytes(tmp_path: Path) -> None:
    file = foxglove_file(tmp_path / "a.mcap", video(9), steady(9))
    fingerprints = []
    for name in ("one", "two"):
        import_recordings([file], tmp_path / name, SMALL)
        fingerprints.append(Dataset.open(tmp_path / name).fingerprint)
    assert fingerprints[0] == fingerprints[1]


def test_the_cache_holds_the_imported_frames(tmp_path: Path) -> None:
    frames = video(9)
    dataset = imported(
        foxglove_file(tmp_path / "a.mcap", frames, steady(9)), tmp_path, ImportOptions(size=32, frames_per_episode=3)
    )
    np.testing.assert_array_equal(dataset.cache().frames, frames)
