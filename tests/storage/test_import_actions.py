"""Actions from other recorders: which one counts at which frame, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from foxglove.channels import RawImageChannel
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.wrappers_pb2 import Int32Value
from storage.foreign import ROS, foxglove_file, raw_image, ros_file, ros_image, steady, video

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.commands import DiscreteCommands, ordered_names
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Clock

OPTIONS = ImportOptions(size=32, actions="/action")


def bag(folder: Path, kind: str, values: list[Any], delay_ns: int = 5_000_000, late_ns: int = 0) -> Path:
    """``delay_ns``: from a picture to its action; ``late_ns``: from a picture's own time stamp to its recording."""
    frames, times = video(len(values) + 1), steady(len(values) + 1)
    messages = []
    for number, (t_ns, frame) in enumerate(zip(times, frames, strict=True)):
        messages.append(
            ("/camera", "sensor_msgs/msg/Image", t_ns + late_ns, ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()))
        )
        if number < len(values):
            messages.append(("/action", kind, t_ns + delay_ns, values[number]))
    return ros_file(folder, messages)


def imported(file: Path, folder: Path, options: ImportOptions = OPTIONS) -> Dataset:
    import_recordings([file], folder / "out", options)
    return Dataset.open(folder / "out")


@pytest.mark.parametrize(
    ("kind", "values", "names"),
    [
        ("std_msgs/msg/Int32", [3, 3, -1, 10], ("-1", "3", "10")),
        ("std_msgs/msg/UInt8", [3, 3, 1, 10], ("1", "3", "10")),
        ("std_msgs/msg/String", ["up", "up", "down", "left"], ("down", "left", "up")),
        ("std_msgs/msg/Bool", [True, False, False, True], ("false", "true")),
    ],
)
@pytest.mark.parametrize("delay_ns", [-5_000_000, 0, 5_000_000])
def test_ros_actions(tmp_path: Path, kind: str, values: list[Any], names: tuple[str, ...], delay_ns: int) -> None:
    dataset = imported(bag(tmp_path / "bag", kind, [{"data": value} for value in values], delay_ns), tmp_path)

    assert dataset.spec.actions == Discrete(names)
    spoken = [str(value).lower() if isinstance(value, bool) else str(value) for value in values]
    assert [names[action] for action in dataset.labels(0).actions] == spoken
    assert not dataset.labels(0).masks.any()


def test_with_the_camera_s_clock_an_action_belongs_to_the_picture_that_was_taken_then(tmp_path: Path) -> None:
    values = ["up", "up", "down", "left"]
    file = bag(tmp_path / "bag", "std_msgs/msg/String", [{"data": value} for value in values], late_ns=150_000_000)
    by_camera = imported(file, tmp_path / "camera", replace(OPTIONS, clock=Clock.HEADER))
    assert [("down", "left", "up")[action] for action in by_camera.labels(0).actions] == values


@pytest.mark.parametrize("late_ns", [1_100_000_000, -1_100_000_000])
def test_a_camera_with_another_clock_than_the_actions_is_refused(tmp_path: Path, late_ns: int) -> None:
    file = bag(tmp_path / "bag", "std_msgs/msg/String", [{"data": "up"}, {"data": "down"}] * 8, late_ns=late_ns)
    side = "before" if late_ns > 0 else "after"
    said = f"are 1.1 s {side} the times of recording, so they are of another clock than the actions"
    with pytest.raises(RecordingImportError, match=re.escape(said)):
        imported(file, tmp_path / "camera", replace(OPTIONS, clock=Clock.HEADER))
    assert len(imported(file, tmp_path / "log")) == 1


def test_actions_that_all_come_too_late_are_said(tmp_path: Path) -> None:
    file = bag(tmp_path / "bag", "std_msgs/msg/String", [{"data": "up"}] * 8, delay_ns=60_000_000_000)
    with pytest.raises(
        RecordingImportError, match=r"no action comes before the last picture, the first one 59.2 s after"
    ):
        imported(file, tmp_path)


def test_words_for_the_same_number_have_one_order_in_every_process() -> None:
    """A set of texts has another order in each process, and the number of an action follows from the order."""
    names = [f"{'0' * zeros}7" for zeros in range(9, -1, -1)]
    given = DiscreteCommands(times_ns=np.arange(11), names=["8", *names[::-1]])
    assert ordered_names([given], 64) == (*names, "8")


def test_json_actions_hold_until_the_next(tmp_path: Path) -> None:
    times = steady(7)
    actions = [(times[0], "left"), (times[3], "right")]
    file = foxglove_file(tmp_path / "a.mcap", video(7), times, actions=actions)
    dataset = imported(file, tmp_path)
    assert [dataset.spec.actions.names[action] for action in dataset.states(0).actions] == ["left"] * 3 + ["right"] * 3


def test_what_comes_before_the_first_action_is_left_out(tmp_path: Path) -> None:
    frames, times = video(8), steady(8)
    file = foxglove_file(tmp_path / "a.mcap", frames, times, actions=[(times[3] + 1, 1), (times[5] + 1, 0)])
    report = import_recordings([file], tmp_path / "out", OPTIONS)
    dataset = Dataset.open(tmp_path / "out")

    np.testing.assert_array_equal(dataset.video(0), frames[3:])
    assert dataset.states(0).actions.tolist() == [1, 1, 0, 0]
    assert report.left_out == 3


def test_video_alone_opens_no_actions(tmp_path: Path) -> None:
    times = steady(5)
    file = foxglove_file(tmp_path / "a.mcap", video(5), times, actions=[(times[0], 1)])
    dataset = imported(file, tmp_path, ImportOptions(size=32))
    assert dataset.spec.actions is None
    assert not (dataset.path / "labels").exists()


def twist() -> dict[str, Any]:
    vector = ROS.types["geometry_msgs/msg/Vector3"](x=1.0, y=0.0, z=0.0)
    return {"linear": vector, "angular": vector}


@pytest.mark.parametrize(
    ("kind", "fields", "reason"),
    [
        ("geometry_msgs/msg/Twist", twist(), "no discrete actions; known are std_msgs"),
        ("std_msgs/msg/Float32", {"data": 0.5}, "no discrete actions; known are std_msgs"),
    ],
)
def test_ros_measurements_are_refused(tmp_path: Path, kind: str, fields: dict[str, Any], reason: str) -> None:
    file = bag(tmp_path / "bag", kind, [fields] * 4)
    with pytest.raises(RecordingImportError, match=reason):
        imported(file, tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", [0.25, [1, 2, 3], None, "", "a\x1b[31mb"])
def test_json_measurements_are_refused(tmp_path: Path, value: Any) -> None:
    times = steady(5)
    file = foxglove_file(tmp_path / "a.mcap", video(5), times, actions=[(times[0], value)])
    with pytest.raises(RecordingImportError, match=r"no choice out of a few.*leaving '--actions' out") as caught:
        imported(file, tmp_path)
    assert "\x1b" not in str(caught.value)


def test_too_many_different_actions_are_refused(tmp_path: Path) -> None:
    times = steady(80)
    file = foxglove_file(tmp_path / "a.mcap", video(80), times, actions=[(t_ns, t_ns) for t_ns in times])
    with pytest.raises(RecordingImportError, match="80 different values, more than the 64"):
        imported(file, tmp_path)


def protobuf_file(path: Path, schema: bytes, messages: list[bytes]) -> Path:
    context, times = foxglove.Context(), steady(len(messages) + 1)
    with foxglove.open_mcap(path, context=context):
        camera = RawImageChannel("/camera", context=context)
        for t_ns in times:
            camera.log(raw_image(t_ns, 4, 4, "rgb8", 12, bytes(48)), log_time=t_ns)
        described = foxglove.Schema(name="google.protobuf.Int32Value", encoding="protobuf", data=schema)
        commands = foxglove.Channel("/action", schema=described, message_encoding="protobuf", context=context)
        for t_ns, message in zip(times, messages, strict=False):
            commands.log(message, log_time=t_ns)
    return path


def test_protobuf_actions(tmp_path: Path) -> None:
    described = FileDescriptorSet()
    Int32Value.DESCRIPTOR.file.CopyToProto(described.file.add())
    messages = [Int32Value(value=value).SerializeToString() for value in (7, 7, 9)]
    dataset = imported(protobuf_file(tmp_path / "a.mcap", described.SerializeToString(), messages), tmp_path)
    assert dataset.spec.actions == Discrete(("7", "9"))
    assert dataset.states(0).actions.tolist() == [0, 0, 1]


def test_an_action_of_a_oneof_counts_where_it_is_set(tmp_path: Path) -> None:
    described = FileDescriptorProto(name="one.proto", package="google.protobuf", syntax="proto3")
    either = described.message_type.add(name="Int32Value")  # the name that ``protobuf_file`` gives
    either.oneof_decl.add(name="which")
    for number, name in enumerate(("action", "value"), 1):
        either.field.add(name=name, number=number, type=FieldDescriptorProto.TYPE_INT32, label=1, oneof_index=0)
    schema = FileDescriptorSet(file=[described]).SerializeToString()
    value = Int32Value  # its field has the number 1, as ``action`` has
    second = b"\x10\x05"  # the field 2 is 5
    messages = [value(value=7).SerializeToString(), second, b"\x08\x00"]
    dataset = imported(protobuf_file(tmp_path / "a.mcap", schema, messages), tmp_path)
    assert [dataset.spec.actions.names[number] for number in dataset.states(0).actions] == ["7", "5", "0"]
    with pytest.raises(RecordingImportError, match=r"message 1 on .* has none of the fields .*'--action-fields'"):
        imported(protobuf_file(tmp_path / "b.mcap", schema, [second, b"", second]), tmp_path / "b")


@pytest.mark.parametrize("schema", [b"", b"\xff\xff", b"\x0a\x03\x0a\x01a"])
def test_a_protobuf_schema_that_is_none_is_refused(tmp_path: Path, schema: bytes) -> None:
    file = protobuf_file(tmp_path / "a.mcap", schema, [b"\x08\x01"] * 3)
    with pytest.raises(RecordingImportError, match="'/action' carries protobuf messages whose schema cannot be used"):
        imported(file, tmp_path)
