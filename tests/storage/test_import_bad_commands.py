"""Commands that cannot be continuous actions: a sentence that helps."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import foxglove
import numpy as np
import pytest
from dmbench_command import dmbench
from foxglove.channels import RawImageChannel
from storage.continuous_recordings import AWKWARD, TWIST, bag, imported, json_file, refused, twist, twists
from storage.foreign import START, raw_image, steady

from dmotion_bench.errors import InvalidSetting, RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands, Reduce
from dmotion_bench.storage.imports.imported_actions import check_pace
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.timeline import Piece


@pytest.mark.slow
def test_an_unknown_field_lists_those_there_are(tmp_path: Path) -> None:
    file = twists(tmp_path / "bag", AWKWARD)
    near = {"linear.q": "linear.[xyz]", "linaer": "linear", "/Angular/Z": "angular.z"}
    hints = {field: f"did you mean '{known}'. I" for field, known in near.items()}
    for field, said in (hints | {"speed": "i"}).items():
        refused(
            file,
            f"message 0 on '/cmd_vel' has no field '{field}'; {said}ts fields are: linear.x, linear.y, linear.z, "
            "angular.x, angular.y, angular.z",
            dataclasses.replace(TWIST, action_fields=(field,)),
        )


@pytest.mark.slow
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_not_finite(tmp_path: Path, number: float) -> None:
    file = twists(tmp_path / "bag", [*AWKWARD[:3], number, *AWKWARD[4:]])
    refused(file, rf"message 3 on '/cmd_vel' holds 'linear.x' = {number}; a command must be finite")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "match"),
    [
        ({"linear": {"x": "fast"}}, "holds 'fast' in 'linear.x', which is no number"),
        ({"linear": {"x": None}}, "holds None in 'linear.x', which is no number"),
        ({"linear": {"x": 2**53 + 1}}, "too large to be kept exactly"),
        ({"linear": {"x": []}}, "holds nothing in 'linear.x'"),
        ({"linear": {"x": list(range(300))}}, "more than 256 numbers in 'linear.x'"),
        ({"linear": {"y": 1.0}}, "has no field 'linear.x'; did you mean 'linear.y'. Its fields are: linear.y"),
        (0.5, "has no field 'linear.x'"),
        ([[]], "has no field 'linear.x'; its fields are: none"),
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_fewer_commands_than_frames(tmp_path: Path) -> None:
    slow = [(START + n * 250_000_000 + 1, twist(n, 0.0)) for n in range(8)]
    file = bag(tmp_path / "bag", "geometry_msgs/msg/Twist", slow, 20)
    refused(file, "has 8 commands on '/cmd_vel' for 19 steps between frames at 10 Hz; .* Lower '--hz' to 4, or import")
    assert len(imported(file, tmp_path / "out", dataclasses.replace(TWIST, hz=4)).states(0).actions) == 7
    once = bag(tmp_path / "once", "geometry_msgs/msg/Twist", [(START, twist(1.0, 0.0))], 20)
    refused(once, "has 1 commands on '/cmd_vel' for 19 steps")


@pytest.mark.parametrize(
    ("rate", "seconds", "said"),
    [
        (4, 20, r"has 80 commands on '/a' for 200 steps .* Lower '--hz' to 4, or import the video alone"),
        (10, 8, r"has 80 .* They come at 10 Hz and are missing for 12 s in all: cut .*, or import the video alone"),
        (20, 8, r"has 160 .* They come at 20 Hz and are missing for 12 s in all: cut .*, or import the video alone"),
    ],
)
def test_commands_that_end_are_told_from_slow_ones(rate: int, seconds: int, said: str) -> None:
    """With a lower rate of frames the steps after the last command would lack one as before."""
    at = np.arange(rate * seconds) * (10**9 // rate)
    commands = ContinuousCommands(times_ns=at, values=np.ones((len(at), 1)), names=("x",))
    piece = Piece(frames=np.arange(201), t_ns=np.arange(201) * 10**8)
    recording = SimpleNamespace(path=Path("a.mcap"), sha256=str)
    with pytest.raises(RecordingImportError, match=said) as caught:
        check_pace(recording, commands, [piece], ImportOptions(actions="/a", action_fields=("x",)))
    assert ("--hz" in str(caught.value)) is (rate < 10)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
