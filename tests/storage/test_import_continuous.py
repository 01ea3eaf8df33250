"""Continuous actions out of recordings: their numbers survive to the bit, and what cannot be one is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from foxglove.channels import RawImageChannel
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from storage.continuous_recordings import AWKWARD, TWIST, bag, bits, imported, json_file, refused, twist, twists
from storage.foreign import START, raw_image, ros_header, steady, video
from storage.hdf5_files import robomimic

from dmotion_bench.actions import Continuous
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot import export_lerobot
from dmotion_bench.storage.imports.cameras import BadPicture
from dmotion_bench.storage.imports.commands import in_force
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands, Reduce, from_rows, reduced
from dmotion_bench.storage.imports.continuous_messages import ContinuousReader
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.mcap_records import TopicInfo
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import steady_times
from dmotion_bench.storage.imports.timeline import Piece, resample


@pytest.mark.slow
@pytest.mark.parametrize("delay_ns", [-5_000_000, 0, 5_000_000])
@pytest.mark.parametrize("reduce", list(Reduce))
def test_one_command_a_frame_is_its_action_to_the_bit(tmp_path: Path, delay_ns: int, reduce: Reduce) -> None:
    options = dataclasses.replace(TWIST, action_reduce=reduce)
    dataset = imported(twists(tmp_path / "bag", AWKWARD, delay_ns), tmp_path / "out", options)
    expected = np.stack([AWKWARD, -np.array(AWKWARD)], axis=1)
    assert bits(dataset.states(0).actions) == bits(expected)
    low, high = expected.min(0), expected.max(0)
    assert dataset.spec.actions == Continuous(
        names=("linear.x", "angular.z"), low=tuple(low.tolist()), high=tuple(high.tolist()), units=("", "")
    )


@pytest.mark.slow
def test_joint_states_have_the_names_of_the_joints(tmp_path: Path) -> None:
    joints = [("elbow", "wrist"), ("wrist", "elbow"), ("elbow", "wrist")]  # the order may change
    given = [
        (
            t_ns + 1,
            {
                "header": ros_header(t_ns),
                "name": list(names),
                "position": np.array([float(len(name)) + n for name in names]),
                "velocity": np.array([0.5 if name == "elbow" else n for name in names]),
                "effort": np.array([]),
            },
        )
        for n, (t_ns, names) in enumerate(zip(steady(3), joints, strict=True))
    ]
    file = bag(tmp_path / "bag", "sensor_msgs/msg/JointState", given, 4, "/joint_states")
    options = ImportOptions(size=32, actions="/joint_states", action_fields=("position", "velocity.elbow"))
    dataset = imported(file, tmp_path / "out", options)
    assert dataset.spec.actions is not None
    assert dataset.spec.actions.names == ("position.elbow", "position.wrist", "velocity.elbow")
    np.testing.assert_array_equal(dataset.states(0).actions, [[5, 5, 0.5], [6, 6, 0.5], [7, 7, 0.5]])
    assert (dataset.spec.actions.low, dataset.spec.actions.high) == ((5, 5, -0.5), (7, 7, 1.5))  # one never changes

    fields = "position.elbow, position.wrist, velocity.elbow, velocity.wrist"
    refused(
        file,
        f"has no field 'effort'; its fields are: {fields}",
        dataclasses.replace(options, action_fields=("effort",)),
    )


@pytest.mark.slow
def test_joints_of_another_publisher_do_not_count(tmp_path: Path) -> None:
    def state(t_ns: int, names: list[str], position: float) -> dict[str, Any]:
        numbers = {
            "position": np.array([float(position)] * len(names)),
            "velocity": np.array([]),
            "effort": np.array([]),
        }
        return {"header": ros_header(t_ns), "name": names, **numbers}

    given = []
    for n, t_ns in enumerate(steady(3)):
        given += [(t_ns, state(t_ns, ["finger"], 0.1)), (t_ns + 1, state(t_ns, ["elbow", "wrist"], n))]
    file = bag(tmp_path / "bag", "sensor_msgs/msg/JointState", given, 4, "/joint_states")
    options = ImportOptions(size=32, actions="/joint_states", action_fields=("position.wrist",))
    report = import_recordings([file], tmp_path / "out", options)
    np.testing.assert_array_equal(Dataset.open(report.path).states(0).actions, [[0], [1], [2]])
    sentence = "3 messages on '/joint_states' hold none of the joints position.wrist and do not count."
    assert sentence in report.advice

    unknown = dataclasses.replace(options, action_fields=("position.wrst",))
    fields = "position.finger, position.elbow, position.wrist"
    refused(file, f"has no field 'position.wrst'; did you mean 'position.wrist'. Its fields are: {fields}", unknown)
    group = dataclasses.replace(options, action_fields=("positn",))
    refused(file, "has no field 'positn'; did you mean 'position'. Its fields are: position.finger", group)
    several = dataclasses.replace(options, action_fields=("position",))
    refused(file, "or the joints of one publisher on the topic", several)


@pytest.mark.slow
def test_numbers_in_lists_and_in_fields_of_fields(tmp_path: Path) -> None:
    commands = [{"pose": {"at": [n, 2.5 * n], "note": "x"}, "grip": -n} for n in range(4)]
    file = json_file(tmp_path / "a.mcap", commands)
    options = dataclasses.replace(TWIST, action_fields=("grip", "pose.at"))
    dataset = imported(file, tmp_path / "out", options)
    assert dataset.spec.actions is not None
    assert dataset.spec.actions.names == ("grip", "pose.at.0", "pose.at.1")
    np.testing.assert_array_equal(dataset.states(0).actions, [[-n, n, 2.5 * n] for n in range(4)])
    assert dataset.manifest.recipe.parameters["action_fields"] == "grip,pose.at"


@pytest.mark.slow
def test_truth_values_are_0_and_1(tmp_path: Path) -> None:
    commands = [{"joint": n, "gripper": n % 2 == 0} for n in range(4)]
    options = dataclasses.replace(TWIST, action_fields=("joint", "gripper"))
    dataset = imported(json_file(tmp_path / "a.mcap", commands), tmp_path / "out", options)
    np.testing.assert_array_equal(dataset.states(0).actions, [[0, 1], [1, 0], [2, 1], [3, 0]])


@pytest.mark.slow
def test_protobuf_fields(tmp_path: Path) -> None:
    described = descriptor_pb2.FileDescriptorProto(name="c.proto", package="c", syntax="proto3")
    inner, outer = described.message_type.add(name="V"), described.message_type.add(name="Command")
    label, kinds = descriptor_pb2.FieldDescriptorProto, descriptor_pb2.FieldDescriptorProto
    inner.field.add(name="x", number=1, type=kinds.TYPE_FLOAT, label=label.LABEL_OPTIONAL)
    outer.field.add(name="v", number=1, type=kinds.TYPE_MESSAGE, type_name=".c.V", label=label.LABEL_OPTIONAL)
    outer.field.add(name="all", number=2, type=kinds.TYPE_DOUBLE, label=label.LABEL_REPEATED)
    outer.field.add(name="again", number=3, type=kinds.TYPE_MESSAGE, type_name=".c.Command", label=label.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(described)
    command = message_factory.GetMessageClass(pool.FindMessageTypeByName("c.Command"))
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context):
        camera = RawImageChannel("/camera", context=context)
        schema = foxglove.Schema(
            name="c.Command",
            encoding="protobuf",
            data=descriptor_pb2.FileDescriptorSet(file=[described]).SerializeToString(),
        )
        channel = foxglove.Channel("/cmd_vel", schema=schema, message_encoding="protobuf", context=context)
        for number, t_ns in enumerate(steady(4)):
            camera.log(raw_image(t_ns, 4, 4, "rgb8", 12, bytes(48)), log_time=t_ns)
            channel.log(command(v={"x": 0.1 * number}, all=[1 / 3, number]).SerializeToString(), log_time=t_ns + 1)
    dataset = imported(tmp_path / "a.mcap", tmp_path / "out", dataclasses.replace(TWIST, action_fields=("v.x", "all")))
    expected = [[float(np.float32(0.1 * number)), 1 / 3, number] for number in range(3)]
    assert bits(dataset.states(0).actions) == bits(expected)
    refused(
        tmp_path / "a.mcap",
        "has no field 'v.y'; did you mean 'v.x'. Its fields are: v.x, all.0, all.1",
        dataclasses.replace(TWIST, action_fields=("v.y",)),
    )


def test_a_number_of_a_oneof_that_was_not_sent_is_no_zero() -> None:
    described = descriptor_pb2.FileDescriptorProto(name="one.proto", package="c", syntax="proto3")
    command = described.message_type.add(name="Command")
    command.oneof_decl.add(name="mode")
    double = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE
    command.field.add(name="velocity", number=1, type=double, label=1, oneof_index=0)
    command.field.add(name="position", number=2, type=double, label=1, oneof_index=0)
    command.field.add(name="grip", number=3, type=double, label=1)
    schema = descriptor_pb2.FileDescriptorSet(file=[described]).SerializeToString()
    pool = descriptor_pool.DescriptorPool()
    pool.Add(described)
    sent = message_factory.GetMessageClass(pool.FindMessageTypeByName("c.Command"))
    topic = TopicInfo("/cmd", "protobuf", "c.Command", "protobuf", schema)

    numbers = ContinuousReader(("velocity", "grip"), most=100).decoder(topic)
    assert numbers(sent(velocity=0.0).SerializeToString()) == [0.0, 0.0]
    with pytest.raises(BadPicture, match="has no field 'velocity'; its fields are: position, grip"):
        numbers(sent(position=7.0, grip=1.0).SerializeToString())


@pytest.mark.parametrize(
    ("reduce", "expected"),
    [
        (Reduce.LAST, [[2.0], [4.0], [8.0], [8.0]]),
        (Reduce.MEAN, [[(1 + 2 + 3) / 3], [(4 + 5 + 6) / 3], [8.0], [8.0]]),
        (Reduce.SUM, [[1.0 + 2 + 3], [4.0 + 5 + 6], [8.0], [0.0]]),
    ],
)
def test_several_commands_become_one_action(reduce: Reduce, expected: list[list[float]]) -> None:
    """Frames at 0, 1 ... 4 s; a step's commands begin a quarter before its frame."""
    times = np.array([-20, 10, 60, 80, 120, 174, 180], np.int64) * 10**7
    commands = ContinuousCommands(times_ns=times, values=np.array([[1.0], [2], [3], [4], [5], [6], [8]]), names=("v",))
    piece = Piece(frames=np.arange(5), t_ns=np.arange(5) * 10**9)
    halfway = np.searchsorted(times, piece.t_ns[:-1] + 5 * 10**8, side="right") - 1
    if reduce is Reduce.LAST:
        expected = [[2.0], [5.0], [8.0], [8.0]]
    np.testing.assert_array_equal(reduced(commands, halfway, piece, reduce), expected)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "hz"), [(60.0, 15.0), (30.0, 7.5), (20.0, 5.0), (60.0, 20.0), (30.0, 10.0)])
@pytest.mark.parametrize("one_less", [False, True])
def test_rows_of_pictures_count_from_their_picture_on(tmp_path: Path, rate: float, hz: float, one_less: bool) -> None:
    """Through the process that reads the file: each step has the rows of its frame and of those up to the next."""
    ratio, count = round(rate / hz), 8 * round(rate / hz) + 1
    rows = np.random.default_rng(0).normal(size=(count - one_less, 2))
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(count)}, actions={"demo_0": rows}, control_freq=rate)
    for reduce, reduction in ((Reduce.SUM, np.add.reduce), (Reduce.MEAN, np.mean)):
        options = ImportOptions(size=32, hz=hz, actions="actions", action_reduce=reduce)
        dataset = imported(file, tmp_path / reduce, options)
        np.testing.assert_array_equal(dataset.video(0), video(count)[::ratio])
        expected = [reduction(rows[step * ratio : (step + 1) * ratio], axis=0) for step in range(8)]
        np.testing.assert_allclose(dataset.states(0).actions, expected, rtol=1e-12)


def test_rows_of_pictures_go_with_the_pictures_that_are_shown() -> None:
    """50 pictures a second at 40 ticks: the frames skip picture 3, so the step before it has two rows."""
    times = steady_times(11, 50, Path("a"))
    (piece,) = resample(times, hz=40, max_gap_s=None, most=100)
    assert piece.frames.tolist() == [0, 1, 2, 4, 5, 6, 7, 9, 10]
    rows = from_rows(2.0 ** np.arange(11), times, "action", most=100)
    actions = reduced(rows, in_force(rows, piece.t_ns), piece, Reduce.SUM)[:, 0]
    assert actions.tolist() == [1, 2, 4 + 8, 16, 32, 64, 128 + 256, 512]


@pytest.mark.parametrize("early_ns", [0, 50_000_000])
def test_a_command_a_quarter_early_counts_for_the_same_step_everywhere(early_ns: int) -> None:
    times = steady_times(241, 60, Path("a"))
    (piece,) = resample(times, hz=15, max_gap_s=None, most=10**6)
    commands = ContinuousCommands(times_ns=times - early_ns, values=np.ones((241, 1)), names=("v",))
    sums = reduced(commands, in_force(commands, piece.t_ns), piece, Reduce.SUM)[:, 0]
    assert set(sums[1:-1].tolist()) == {4.0}


def test_a_sum_of_displacements_is_the_whole_way(tmp_path: Path) -> None:
    """Commands at 50 Hz, frames at 10: nothing is counted twice, nothing is lost, and the bounds hold the sums."""
    steps = np.random.default_rng(0).integers(-8, 9, 45)
    given = [(START + n * 20_000_000, twist(float(step), 0.25)) for n, step in enumerate(steps)]
    file = bag(tmp_path / "bag", "geometry_msgs/msg/Twist", given, 10)
    dataset = imported(file, tmp_path / "out", dataclasses.replace(TWIST, action_reduce=Reduce.SUM))
    actions = dataset.states(0).actions
    assert actions[:, 0].sum() == steps[: 9 * 5 - 1].sum()  # the last comes within a quarter of the last frame
    assert dataset.spec.actions is not None
    assert (dataset.spec.actions.low[0], dataset.spec.actions.high[0]) == (actions[:, 0].min(), actions[:, 0].max())
    assert dataset.manifest.recipe.parameters["action_reduce"] == "sum"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "kind"), [(AWKWARD, "float64"), (np.float32([0.1, -0.0, 1 / 3, 1e-40, 3e38, 7.0]).tolist(), "float32")]
)
@pytest.mark.parametrize("fields", [("linear.x",), ("linear.x", "angular.z")])
def test_to_lerobot_and_back_again(tmp_path: Path, values: list[float], kind: str, fields: tuple[str, ...]) -> None:
    options = dataclasses.replace(TWIST, action_fields=fields)
    dataset = imported(twists(tmp_path / "bag", values), tmp_path / "out", options)
    export_lerobot(dataset, tmp_path / "lerobot")
    info = json.loads((tmp_path / "lerobot/meta/info.json").read_text())
    action = info["features"]["action"]
    assert (action["dtype"], action["shape"], action["names"]) == (kind, [len(fields)], list(fields))
    back = imported(tmp_path / "lerobot", tmp_path / "back", ImportOptions(size=32, actions="action"))
    assert back.spec.actions == dataset.spec.actions
    assert bits(back.states(0).actions) == bits(dataset.states(0).actions)


@pytest.mark.slow
def test_robomimic_s_actions(tmp_path: Path) -> None:
    given = {f"demo_{n}": np.random.default_rng(n).normal(size=(5, 7)) for n in range(2)}
    file = robomimic(tmp_path / "a.hdf5", {name: video(5) for name in given}, actions=given)
    options = ImportOptions(size=32, actions="actions")
    dataset = imported(file, tmp_path / "out", options)
    assert dataset.spec.actions is not None
    assert dataset.spec.actions.names == tuple(f"actions.{n}" for n in range(7))
    for number, actions in enumerate(given.values()):
        assert bits(dataset.states(number).actions) == bits(actions[:4])
    kept = np.concatenate([actions[:4] for actions in given.values()])
    assert (dataset.spec.actions.low, dataset.spec.actions.high) == (tuple(kept.min(0)), tuple(kept.max(0)))

    one = imported(file, tmp_path / "one", dataclasses.replace(options, action_fields=("actions.6", "actions.0")))
    assert bits(one.states(0).actions) == bits(given["demo_0"][:4, [6, 0]])
    refused(file, "has no field 'x' .*its fields are: 'actions.0'", dataclasses.replace(options, action_fields=("x",)))
    typo = dataclasses.replace(options, action_fields=("action[6]",))
    refused(file, r"did you mean 'actions.6'\? .* \('/data/demo_0/actions'\)\.$", typo)  # and no way around damage
    few = dataclasses.replace(options, limits=ImportLimits(numbers=34))
    refused(file, "holds 35 numbers as actions, more than the 34", few)

    given["demo_1"][2, 3] = np.nan
    broken = robomimic(tmp_path / "b.hdf5", {name: video(5) for name in given}, actions=given)
    refused(broken, "holds 'actions.3' = nan in command 2; a command must be finite", options)
