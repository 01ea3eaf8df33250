"""Continuous actions out of recordings: their numbers survive to the bit, and what cannot be one is refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from dmbench_command import dmbench
from foxglove.channels import RawImageChannel
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from storage.foreign import ROS, START, raw_image, ros_file, ros_header, ros_image, steady, video
from storage.test_import_hdf5 import robomimic

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import InvalidSetting, RecordingImportError
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot import export_lerobot
from dmotion_bench.storage.imports.commands import in_force
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands, Reduce, from_rows, reduced
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import steady_times
from dmotion_bench.storage.imports.timeline import Piece, resample

TWIST = ImportOptions(size=32, actions="/cmd_vel", action_fields=("linear.x", "angular.z"))
AWKWARD = [0.1, -0.0, 1 / 3, -5e-324, 1.7976931348623157e300, 123456789.000001]
"""Numbers that do not survive a detour through text of few digits or through 32 bits."""


def twist(x: float, z: float) -> dict[str, Any]:
    vector = ROS.types["geometry_msgs/msg/Vector3"]
    return {"linear": vector(x=x, y=0.0, z=0.0), "angular": vector(x=0.0, y=0.0, z=z)}


def bag(
    folder: Path, kind: str, commands: Sequence[tuple[int, dict[str, Any]]], frames: int, topic: str = "/cmd_vel"
) -> Path:
    """A camera at 10 Hz, and commands at their times [ns]."""
    pictures = [
        ("/camera", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()))
        for t_ns, frame in zip(steady(frames), video(frames), strict=True)
    ]
    given = [(topic, kind, t_ns, fields) for t_ns, fields in commands]
    return ros_file(folder, sorted([*pictures, *given], key=lambda message: message[2]))


def twists(folder: Path, numbers: Sequence[float], delay_ns: int = 5_000_000) -> Path:
    """A twist for each step."""
    times = steady(len(numbers))
    given = [(t_ns + delay_ns, twist(x, -x)) for t_ns, x in zip(times, numbers, strict=True)]
    return bag(folder, "geometry_msgs/msg/Twist", given, len(numbers) + 1)


def json_file(path: Path, commands: Sequence[Any], frames: int | None = None) -> Path:
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        camera = RawImageChannel("/camera", context=context)
        for t_ns in steady(frames or len(commands) + 1):
            camera.log(raw_image(t_ns, 4, 4, "rgb8", 12, bytes(48)), log_time=t_ns)
        channel = foxglove.Channel("/cmd_vel", message_encoding="json", context=context)
        for t_ns, command in zip(steady(len(commands)), commands, strict=True):
            text = command if isinstance(command, bytes) else json.dumps(command).encode()
            channel.log(text, log_time=t_ns + 1)
    return path


def imported(path: Path, folder: Path, options: ImportOptions = TWIST) -> Dataset:
    dataset = Dataset.open(import_recordings([path], folder, options).path)
    assert not check_dataset(dataset.path).damages
    return dataset


def refused(path: Path, match: str, options: ImportOptions = TWIST) -> None:
    out = path.parent / "refused"
    with pytest.raises(RecordingImportError, match=match) as caught:
        import_recordings([path], out, options)
    assert not list(path.parent.glob("refused*"))
    assert "\x1b" not in str(caught.value)


def bits(values: Any) -> list[bytes]:
    return [struct.pack("<d", number) for number in np.asarray(values, np.float64).reshape(-1)]


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
        f"has no field 'effort'; .*Its fields are: {fields}",
        dataclasses.replace(options, action_fields=("effort",)),
    )


def test_numbers_in_lists_and_in_fields_of_fields(tmp_path: Path) -> None:
    commands = [{"pose": {"at": [n, 2.5 * n], "note": "x"}, "grip": -n} for n in range(4)]
    file = json_file(tmp_path / "a.mcap", commands)
    options = dataclasses.replace(TWIST, action_fields=("grip", "pose.at"))
    dataset = imported(file, tmp_path / "out", options)
    assert dataset.spec.actions is not None
    assert dataset.spec.actions.names == ("grip", "pose.at.0", "pose.at.1")
    np.testing.assert_array_equal(dataset.states(0).actions, [[-n, n, 2.5 * n] for n in range(4)])
    assert dataset.manifest.recipe.parameters["action_fields"] == "grip,pose.at"


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


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read only; ``lerobot`` changes a copy."""
    root = tmp_path_factory.mktemp("exported")
    export_lerobot(imported(twists(root / "bag", AWKWARD), root / "source"), root / "lerobot")
    return root / "lerobot"


def lerobot(exported: Path, tmp_path: Path, actions: Any, feature: dict[str, Any]) -> Path:
    """An export whose actions are replaced, as another program would have written them."""
    folder = shutil.copytree(exported, tmp_path / "lerobot")
    file = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(table.set_column(table.column_names.index("action"), "action", actions), file)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["action"] = feature
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


LEROBOT = ImportOptions(size=32, actions="action")
ROWS = [[n / 3, n] for n in range(7)]


@pytest.mark.parametrize(
    ("stated", "names"),
    [
        (["a", "b"], ("a", "b")),
        ({"motors": ["a", "b"]}, ("a", "b")),
        ({"b": 1, "a": 0}, ("a", "b")),
        (None, ("action.0", "action.1")),
        (["only"], ("action.0", "action.1")),
    ],
)
def test_lerobot_s_own_actions(exported: Path, tmp_path: Path, stated: Any, names: tuple[str, ...]) -> None:
    column = pa.array(ROWS, pa.list_(pa.float32()))
    folder = lerobot(exported, tmp_path, column, {"dtype": "float32", "shape": [2], "names": stated})
    dataset = imported(folder, tmp_path / "out", LEROBOT)
    assert dataset.spec.actions is not None
    assert dataset.spec.actions.names == names
    assert bits(dataset.states(0).actions) == bits(np.float32(ROWS[:6]))
    part = imported(folder, tmp_path / "part", dataclasses.replace(LEROBOT, action_fields=(names[1],)))
    np.testing.assert_array_equal(part.states(0).actions[:, 0], range(6))


FLOATS: dict[str, Any] = {"dtype": "float32", "shape": [2], "names": ["a", "b"]}


@pytest.mark.parametrize(
    ("rows", "feature", "match"),
    [
        ([*ROWS[:3], [0.0, np.nan], *ROWS[4:]], FLOATS, "holds 'b' = nan in command 3; a command must be finite"),
        ([*ROWS[:3], [np.inf, 0.0], *ROWS[4:]], FLOATS, "holds 'a' = inf in command 3"),
        ([*ROWS[:3], [1.0], *ROWS[4:]], FLOATS, "different numbers of components"),
        ([*ROWS[:3], [None, 1.0], *ROWS[4:]], FLOATS, "lacks numbers of its actions"),
        ([*ROWS[:3], None, *ROWS[4:]], FLOATS, "different numbers of components"),
        ([[0.0] * 300] * 7, FLOATS, "holds 300 numbers a command; there can be 1 to 256"),
        (ROWS, FLOATS | {"names": ["a\x1b[31m", "b"]}, "printable characters"),
        (ROWS, FLOATS | {"names": ["a", "a"]}, "two numbers of the same name"),
        (ROWS, FLOATS | {"dmbench_actions": {"names": ["a"]}}, "dmbench_actions of the feature 'action' that cannot"),
        (
            ROWS,
            FLOATS | {"dmbench_actions": {"names": ["a", "b"], "low": [0, 0], "high": [1, 9], "units": ["", ""]}},
            "contradicts its own bounds: it holds 'a' = 1.33333 in action 4; it can be 0 to 1",
        ),
        (
            ROWS,
            FLOATS | {"dmbench_actions": {"names": ["a", "c"], "low": [0, 0], "high": [1, 9], "units": ["", ""]}},
            "states bounds of 'a', 'c', and its numbers are 'a', 'b'",
        ),
    ],
)
def test_lerobot_s_actions_that_cannot_be(
    exported: Path, tmp_path: Path, rows: Any, feature: dict[str, Any], match: str
) -> None:
    refused(lerobot(exported, tmp_path, pa.array(rows, pa.list_(pa.float32())), feature), match, LEROBOT)


def test_words_are_no_numbers(exported: Path, tmp_path: Path) -> None:
    refused(
        lerobot(exported, tmp_path, pa.array(["x"] * 7), FLOATS), "holds string as actions, which is no number", LEROBOT
    )


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
    refused(file, "has no field 'x' .*Its fields are: 'actions.0'", dataclasses.replace(options, action_fields=("x",)))
    few = dataclasses.replace(options, limits=ImportLimits(numbers=34))
    refused(file, "holds 35 numbers as actions, more than the 34", few)

    given["demo_1"][2, 3] = np.nan
    broken = robomimic(tmp_path / "b.hdf5", {name: video(5) for name in given}, actions=given)
    refused(broken, "holds 'actions.3' = nan in command 2; a command must be finite", options)


def test_an_unknown_field_lists_those_there_are(tmp_path: Path) -> None:
    file = twists(tmp_path / "bag", AWKWARD)
    for field, said in (("linear.q", "did you mean 'linear.[xyz]'. "), ("speed", "")):
        refused(
            file,
            f"message 0 on '/cmd_vel' has no field '{field}'; {said}Its fields are: linear.x, linear.y, linear.z, "
            "angular.x, angular.y, angular.z",
            dataclasses.replace(TWIST, action_fields=(field,)),
        )


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_not_finite(tmp_path: Path, number: float) -> None:
    file = twists(tmp_path / "bag", [*AWKWARD[:3], number, *AWKWARD[4:]])
    refused(file, rf"message 3 on '/cmd_vel' holds 'linear.x' = {number}; a command must be finite")


@pytest.mark.parametrize(
    ("command", "match"),
    [
        ({"linear": {"x": "fast"}}, "holds 'fast' in 'linear.x', which is no number"),
        ({"linear": {"x": True}}, "holds True in 'linear.x', which is no number"),
        ({"linear": {"x": None}}, "holds None in 'linear.x', which is no number"),
        ({"linear": {"x": 2**53 + 1}}, "too large to be kept exactly"),
        ({"linear": {"x": []}}, "holds nothing in 'linear.x'"),
        ({"linear": {"x": list(range(300))}}, "more than 256 numbers in 'linear.x'"),
        ({"linear": {"y": 1.0}}, "has no field 'linear.x'; did you mean 'linear.y'. Its fields are: linear.y"),
        (0.5, "has no field 'linear.x'"),
        ([[]], "has no field 'linear.x'; Its fields are: none"),
        ({"linear": {"x": {"\x1b[31m": 1.0}}}, "printable characters"),
        (b'{"linear": {"x": 1e999}}', "'linear.x' = inf; a command must be finite"),
        (b'{"linear": {"x": NaN}}', "'linear.x' = nan; a command must be finite"),
        (b'{"linear": {"x": ' + b"[" * 500 + b"1" + b"]" * 500 + b"}}", "has more than 32 levels"),
        (b'{"linear": {"x": ' + b"[" * 100_000, "cannot be decoded as .*recursion"),
    ],
)
def test_json_that_is_no_command(tmp_path: Path, command: Any, match: str) -> None:
    file = json_file(tmp_path / "a.mcap", [command] * 4)
    refused(file, match, dataclasses.replace(TWIST, action_fields=("linear.x",)))


def test_commands_that_change_their_fields(tmp_path: Path) -> None:
    options = dataclasses.replace(TWIST, action_fields=("v",))
    shorter = json_file(tmp_path / "a.mcap", [{"v": [1.0, 2.0]}, {"v": [1.0]}, {"v": [1.0, 2.0]}])
    refused(shorter, "message 1 on '/cmd_vel' lacks the numbers 'v.1', other than the first message", options)
    longer = json_file(tmp_path / "b.mcap", [{"v": [1.0]}, {"v": [1.0, 2.0]}, {"v": [1.0]}])
    refused(longer, "message 1 on '/cmd_vel' has beside the others the numbers 'v.1'", options)


def test_recordings_with_other_actions(tmp_path: Path) -> None:
    one = json_file(tmp_path / "a.mcap", [{"v": {"x": n}} for n in range(4)])
    other = json_file(tmp_path / "b.mcap", [{"v": {"y": n}} for n in range(4)])
    with pytest.raises(RecordingImportError, match=r"different actions: 'v\.x' in one, 'v.y' in another"):
        import_recordings([one, other], tmp_path / "out", dataclasses.replace(TWIST, action_fields=("v",)))
    assert not (tmp_path / "out").exists()


def test_fewer_commands_than_frames(tmp_path: Path) -> None:
    slow = [(START + n * 250_000_000 + 1, twist(n, 0.0)) for n in range(8)]
    file = bag(tmp_path / "bag", "geometry_msgs/msg/Twist", slow, 20)
    refused(file, "has 8 commands on '/cmd_vel' for 19 steps between frames at 10 Hz; .* Lower '--hz' to 4, or import")
    assert len(imported(file, tmp_path / "out", dataclasses.replace(TWIST, hz=4)).states(0).actions) == 7
    once = bag(tmp_path / "once", "geometry_msgs/msg/Twist", [(START, twist(1.0, 0.0))], 20)
    refused(once, "has 1 commands on '/cmd_vel' for 19 steps")


@pytest.mark.parametrize("reduce", list(Reduce))
def test_steps_without_a_command_of_their_own_are_counted(tmp_path: Path, reduce: Reduce) -> None:
    """Commands at 50 Hz for 3 of 6 seconds: more than there are steps, and none for the second half."""
    given = [(START + n * 20_000_000, twist(n + 1.0, 0.5)) for n in range(150)]
    file = bag(tmp_path / "bag", "geometry_msgs/msg/Twist", given, 60)
    options = dataclasses.replace(TWIST, action_reduce=reduce)
    report = import_recordings([file], tmp_path / "out", options)
    (actions,) = [Dataset.open(report.path).states(number).actions[:, 0] for number in range(report.episodes)]
    without = actions == 0 if reduce is Reduce.SUM else np.diff(actions) == 0
    assert without.sum() == 28
    what = "their sum is zero" if reduce is Reduce.SUM else "they repeat an earlier one"
    assert f"28 of 59 steps have no command of their own on '/cmd_vel': {what}." in report.advice[-1]

    cut_in_parts = dataclasses.replace(options, frames_per_episode=20)
    parts = import_recordings([file], tmp_path / "parts", cut_in_parts)
    assert "27 of 57 steps have no command of their own" in parts.advice[-1]  # one is between two parts


@pytest.mark.parametrize("delay_ns", [-5_000_000, 0, 5_000_000])
@pytest.mark.parametrize("reduce", list(Reduce))
def test_a_command_a_step_is_no_reason_for_advice(tmp_path: Path, delay_ns: int, reduce: Reduce) -> None:
    file = twists(tmp_path / "bag", np.arange(30.0).tolist(), delay_ns)
    report = import_recordings([file], tmp_path / "out", dataclasses.replace(TWIST, action_reduce=reduce))
    assert not any("of their own" in sentence for sentence in report.advice)


def test_options_that_do_not_go_together(tmp_path: Path) -> None:
    with pytest.raises(InvalidSetting, match="no actions are asked for; name their topic or feature with '--actions'"):
        ImportOptions(action_fields=("linear.x",))
    for fields in (("x", "x"), ("x", "")):
        with pytest.raises(InvalidSetting, match="has an empty field, or a field twice"):
            ImportOptions(actions="/cmd_vel", action_fields=fields)
    words = json_file(tmp_path / "a.mcap", [{"action": name} for name in ("up", "down", "up")])
    discrete = ImportOptions(size=32, actions="/cmd_vel", action_reduce=Reduce.MEAN)
    refused(words, "'--action-reduce mean' is for continuous actions, and the actions are discrete", discrete)
    alone = ImportOptions(size=32, action_reduce=Reduce.SUM)
    refused(words, "'--action-reduce sum' is for continuous actions, and there are no actions", alone)


def test_too_many_numbers(tmp_path: Path) -> None:
    file = twists(tmp_path / "bag", AWKWARD)
    refused(file, "more than the 11 numbers", dataclasses.replace(TWIST, limits=ImportLimits(numbers=11)))


@pytest.mark.slow
def test_a_definition_that_takes_all_time_is_stopped(tmp_path: Path) -> None:
    """Arrays of bytes may end early in a decoder; an array of those takes no bytes at all, and no end of time."""
    writer_file = tmp_path / "a.mcap"
    context = foxglove.Context()
    definition = b"S[] all\n" + b"=" * 80 + b"\nMSG: evil/S\nuint8[3] few\n"
    with foxglove.open_mcap(writer_file, context=context):
        camera = RawImageChannel("/camera", context=context)
        schema = foxglove.Schema(name="evil/msg/Evil", encoding="ros2msg", data=definition)
        channel = foxglove.Channel("/cmd_vel", schema=schema, message_encoding="cdr", context=context)
        for t_ns in steady(4):
            camera.log(raw_image(t_ns, 4, 4, "rgb8", 12, bytes(48)), log_time=t_ns)
            channel.log(b"\x00\x01\x00\x00\xff\xff\xff\xff", log_time=t_ns + 1)
    tight = ImportLimits(reader_bytes=256 << 20, reader_seconds=1)
    options = dataclasses.replace(TWIST, limits=tight, action_fields=("all.0.few",))
    refused(writer_file, r"keeps its decoder busy for more than 1 s|takes more than 256 MiB", options)


@pytest.mark.parametrize("definition", [b"", b"float64", b"Nothing x\n", b"\xff\xfe", b"float64[99999999999] x\n"])
def test_a_definition_that_is_none(tmp_path: Path, definition: bytes) -> None:
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context):
        camera = RawImageChannel("/camera", context=context)
        schema = foxglove.Schema(name="odd/msg/Odd", encoding="ros2msg", data=definition)
        channel = foxglove.Channel("/cmd_vel", schema=schema, message_encoding="cdr", context=context)
        for t_ns in steady(4):
            camera.log(raw_image(t_ns, 4, 4, "rgb8", 12, bytes(48)), log_time=t_ns)
            channel.log(b"\x00\x01\x00\x00" + bytes(8), log_time=t_ns + 1)
    refused(tmp_path / "a.mcap", "'/cmd_vel'", dataclasses.replace(TWIST, action_fields=("x",)))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = str(twists(tmp_path / "bag", [0.25, 0.5, -0.5, 1.0]))
    words = ["data", "import", file, "--size", "32", "--out", "drive", "--actions", "/cmd_vel"]
    fields = ["--action-fields", "linear.x,angular.z", "--action-reduce", "mean"]
    done = dmbench([*words, *fields], capsys, monkeypatch)
    assert "actions, held out as labels: linear.x (-0.5 to 1), angular.z (-1 to 0.5)" in done.out
    told = json.loads(dmbench([*words, *fields, "--json"], capsys, monkeypatch).out)
    assert told["actions"]["names"] == ["linear.x", "angular.z"]
    assert "linear.x (-0.5 to 1), angular.z (-1 to 0.5)" in dmbench(["data", "info", "drive"], capsys, monkeypatch).out
    exported = dmbench(["data", "export", "drive", "--out", "lerobot"], capsys, monkeypatch)
    assert "5 frames, with actions" in exported.out

    alone = dmbench(["data", "import", file, "--action-fields", "linear.x", "--out", "b"], capsys, monkeypatch)
    assert (alone.code, (tmp_path / "b").exists()) == (2, False)
    assert "no actions are asked for; name their topic or feature with '--actions'" in alone.err
    odd = dmbench([*words, "--action-reduce", "mode"], capsys, monkeypatch)
    assert odd.code == 2
    assert "last, mean, sum" in odd.err
