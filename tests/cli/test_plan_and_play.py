"""``dmbench plan`` and ``dmbench play`` as a user types them."""

from __future__ import annotations

import json
import os
import pty
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from dmbench_command import Outcome, dmbench
from known_model import result_of
from PIL import Image
from rrd_contents import curve, read

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.api.driving import Driven, open_driven
from dmotion_bench.cli.keys import read_keys, single_keys
from dmotion_bench.cli.play import bindings, changes, commands, legend, moves, taken_actions
from dmotion_bench.errors import LabelsNotAvailable, UsageError
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.planning.tasks import load_problems, task_environment
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.captions import GAP, LINE, SIDE
from dmotion_bench.workspace import Workspace
from recorders.grid_world import GridWorld


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A small Grid World and a run on it whose model has learned nothing."""
    workspace = Workspace(tmp_path_factory.mktemp("workspace"))
    folder = workspace.data / "grid"
    record_dataset(folder, DatasetRecipe(environment="grid_world", policy="random", episodes=30, frames=32, tasks=3))
    _unlearned(TrainingRequest(model="dmotion", preset=Preset.TINY), Dataset.open(folder), workspace)
    return workspace


def _unlearned(request: TrainingRequest, dataset: Dataset, workspace: Workspace) -> None:
    """A finished run whose model has learned nothing."""
    run = open_run(request, dataset, None, workspace)
    weights = run.spec.build().state_dict()
    checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
    run.finish(result_of(weights))


def _play(
    words: list[str], keys: bytes, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Outcome:
    """What ``dmbench play`` says to somebody who presses these keys."""
    controller, terminal = pty.openpty()
    os.write(controller, keys)
    with os.fdopen(terminal, "r+b", buffering=0) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        said = dmbench(["play", *words], capsys, monkeypatch)
    os.close(controller)
    return said


@pytest.fixture(autouse=True)
def _here(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(workspace.root))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")


@pytest.fixture
def run(workspace: Workspace) -> str:
    (path,) = workspace.all_runs()
    return path.name


@pytest.mark.slow
def test_a_plan_is_recorded_for_rerun(
    run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "plan.rrd"
    said = dmbench(["plan", run, "--task", "1", "--steps", "2", "--save", str(file), "--json"], capsys, monkeypatch)
    assert (said.code, said.err) == (0, "")
    found = json.loads(said.out)
    assert (found["run"], found["task"], found["steps"], found["planner"]) == (run, 1, 2, "cem")
    assert len(found["actions"]) == 2
    assert set(found["actions"]) <= {"up", "down", "left", "right"}
    assert [value for _, value in curve(file, "/distance")] == pytest.approx(found["distance"][:2], abs=1e-6)
    contents = read(file)
    for entity in ("/camera", "/imagined", "/cost", "/candidates"):
        assert len(next(iter(contents[entity].values()))) == 2, entity
    assert "/goal" in contents
    strip = contents["/imagined"]["Image:format"][0][1][0]
    assert (strip["width"], strip["height"]) == (5 * 130, 3 * 130)
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.slow
def test_a_filmstrip_is_written_of_a_columns_plan(
    run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "plan.png"
    said = dmbench(["plan", run, "--steps", "2", "--column", "paper", "--save", str(file)], capsys, monkeypatch)
    assert said.code == 0
    assert f"The filmstrip is {str(file)!r}." in said.out
    with Image.open(file) as picture:
        assert picture.width == GAP + 4 * (SIDE + GAP)  # start, after 1, after 2, goal
        start = np.asarray(picture)[3 * LINE : 3 * LINE + SIDE : 2, GAP : GAP + SIDE : 2]
    (problem,) = load_problems(Dataset.open(Workspace(os.environ["DMBENCH_WORKSPACE"]).data / "grid"), [0])
    np.testing.assert_array_equal(start, problem.start_frame)


@pytest.mark.slow
def test_references_are_planned_with_by_name(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    idle = json.loads(dmbench(["plan", "idle", "--steps", "3", "--json"], capsys, monkeypatch).out)
    assert idle["distance"] == [1, 1, 1, 1]
    assert idle["actions"] == [None] * 3
    oracle = json.loads(dmbench(["plan", "oracle", "--steps", "8", "--json"], capsys, monkeypatch).out)
    assert oracle["final_distance"] < 1
    again = json.loads(dmbench(["plan", "oracle", "--steps", "8", "--json"], capsys, monkeypatch).out)
    assert again["actions"] == oracle["actions"]


@pytest.mark.slow
def test_references_are_scored_by_name(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["score", "idle", "random", "--metrics", "control", "--tasks", "2"]
    said = dmbench([*words, "--json"], capsys, monkeypatch)
    assert (said.code, said.err) == (0, "")
    idle, random = json.loads(said.out)["reports"]
    assert (idle["run"], random["run"], idle["dataset"]) == ("idle", "random", "grid")
    of_two = {"low": None, "high": None, "n": 2, "episodes": 2}
    assert idle["figures"]["control_distance[100]"] == {"mean": 1, "std": 0, **of_two}
    assert len(list((workspace.data / "grid/cache").glob("control-random-*.json"))) == 1
    table = dmbench(words, capsys, monkeypatch).out
    assert "control, distance after 40 steps" in table
    assert table.count("95% interval") == 3  # of each reference, and why they are empty
    assert "95% interval: too few episodes" in table


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["plan", "idle"], 1, "this machine has no display"),
        (["plan", "idle", "--save", "plan.mp4"], 2, "must end in .rrd, for Rerun, or in .png, for a filmstrip"),
        (["plan", "idle", "--json", "--column", "generics"], 2, "did you mean 'generic'"),
        (["plan", "idle", "--json", "--column", "paper", "--planner", "cem"], 2, "'paper' says how to plan"),
        (["plan", "idle", "--json", "--web"], 2, "--json shows nothing, and --web shows a page"),
        (["plan", "idle", "--json", "--task", "3"], 2, "no task named '3'; known: 0 to 2"),
        (["plan", "idle", "--json", "--planner", "exhausting"], 2, "did you mean 'exhaustive'"),
        (["plan", "idle", "--json", "--cost", "pixels"], 2, "did you mean 'pixel'"),
        (["plan", "nobody"], 2, "no run named 'nobody'"),  # rather than that there is no display
        (["play", "--save", "play.mp4"], 2, "must end in .rrd"),
    ],
)
def test_mistakes_get_one_sentence(
    words: list[str], code: int, sentence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = dmbench(words, capsys, monkeypatch)
    assert said.code == code
    assert sentence in said.sentence()
    assert said.out == ""


def test_an_episode_that_there_is_not_cannot_be_played(run: str) -> None:
    with pytest.raises(UsageError, match="has no episode 99; it has 0 to"):
        open_driven(run, 99, Workspace.current())


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "the memory does not suffice for this; take a smaller model"),
        (RuntimeError("can't allocate memory: you tried to allocate 8589934592 bytes"), "this: 8.0 GiB were asked for"),
    ],
)
def test_too_little_memory_is_a_sentence(
    error: Exception, said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("dmotion_bench.cli.app.register_commands", short)
    outcome = dmbench(["info"], capsys, monkeypatch)
    assert outcome.code == 1
    assert said in outcome.sentence()


def test_playing_needs_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        said = dmbench(["play"], capsys, monkeypatch)
    assert said.code == 2
    assert "reads keys from a terminal" in said.sentence()


def test_keys_drive_the_model(
    run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, closed = tmp_path / "play.rrd", list[GridWorld]()
    monkeypatch.setattr(GridWorld, "close", lambda env: closed.append(env))
    said = _play([run, "--save", str(file)], b"\x1b[A\x1b[Cx4r\x1bOBq", capsys, monkeypatch)
    assert said.code == 0, said.err
    assert len(closed) == 1
    assert "3: up right right" in said.err
    assert said.err.rstrip().endswith("1: down")
    assert said.out == f"Watch it with 'dmbench view {file}'.\n"
    contents = read(file)
    for entity in ("/imagined", "/simulator"):
        assert [place for place, _ in contents[entity]["Image:buffer"]] == list(range(6)), entity
    frames = [frame for _, frame in contents["/simulator"]["Image:buffer"]]
    assert frames[4] == frames[0]  # started over


@pytest.mark.slow
def test_keys_drive_a_model_of_continuous_actions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = Workspace(tmp_path / "workspace")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(workspace.root))
    folder = workspace.data / "planar"
    recipe = DatasetRecipe(
        environment="planar_push", parameters={"actions": "continuous"}, policy="push", episodes=10, frames=6
    )
    record_dataset(folder, recipe)
    dataset = Dataset.open(folder)
    _unlearned(TrainingRequest(model="dmotion", preset=Preset.TINY, labels="8"), dataset, workspace)
    file = tmp_path / "play.rrd"
    said = _play(["--save", str(file)], b"\x1b[A\x1b[C4r\x1b[Dq", capsys, monkeypatch)
    assert said.code == 0, said.err
    assert "left or 1 dx=-0.04m, right or 2 dx=0.04m, down or 3 dy=-0.04m, up or 4 dy=0.04m; r starts" in said.err
    assert "3: dy=0.04m dx=0.04m dy=0.04m" in said.err
    assert said.err.rstrip().endswith("1: dx=-0.04m")
    shown = [bytes(frame) for _, (frame,) in read(file)["/simulator"]["Image:buffer"]]
    env = task_environment(dataset.recipe)
    start = env.reset(seed=dataset.rows[int(dataset.split("test")[0])].seed)[0]
    there = [env.step(np.array(action))[0] for action in ((0.0, 0.04), (0.04, 0.0), (0.0, 0.04))]
    assert shown[:5] == [frame.tobytes() for frame in (start, *there, start)]
    assert len(read(file)["/imagined"]["Image:buffer"]) == 6


def test_the_terminal_is_left_as_it_was() -> None:
    import termios

    controller, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)

    def interrupted() -> None:
        with single_keys(terminal):
            assert not termios.tcgetattr(terminal)[3] & termios.ECHO
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert termios.tcgetattr(terminal) == before
    os.close(controller)
    os.close(terminal)


def test_keys_are_read_one_by_one() -> None:
    reader, writer = os.pipe()
    os.write(writer, b"\x1b[A\x1b[B\x1b[C\x1b[Da\x1bOA\x1b[Zq\x1b")
    os.close(writer)
    assert list(read_keys(reader)) == ["up", "down", "right", "left", "a", "up", "q", "escape"]
    os.close(reader)


@pytest.mark.parametrize(
    ("sent", "keys"),
    [
        (b"\x1b[1;2C3", ["right", "3"]),  # with Shift
        (b"\x1b[1;5D", ["left"]),  # with Control
        (b"\x1b[15~4", ["4"]),  # F5
        (b"\x1b[3~", []),  # Delete
        (b"\x1bOP1", ["1"]),  # F1
        (b"\x1bx1", ["1"]),  # Alt and x
    ],
)
def test_the_numbers_within_a_key_are_no_keys(sent: bytes, keys: list[str]) -> None:
    reader, writer = os.pipe()
    os.write(writer, sent)
    os.close(writer)
    assert list(read_keys(reader)) == keys
    os.close(reader)


def test_arrows_take_the_actions_of_their_names_and_digits_any() -> None:
    four = bindings(moves(Discrete(("up", "down", "left", "right"))))
    assert four["left"].action == four["3"].action == 2
    two = moves(Discrete(("grip", "up")))
    assert {key: move.action for key, move in bindings(two).items()} == {"up": 1, "1": 0, "2": 1}
    taken = commands(iter(["1", "x", "up", "r", "q", "1"]), two)
    assert [None if move is None else move.action for move in taken] == [0, 1, None]


ARM = Continuous(names=("lift", "turn"), low=(-90.0, 10.0), high=(110.0, 30.0), units=("deg", "deg"))


def test_the_command_of_an_import_is_changed_one_number_at_a_time() -> None:
    known = changes(ARM)
    assert {key: move.name for key, move in bindings(known).items() if key.isdigit()} == {
        "1": "lift-10deg",
        "2": "lift+10deg",
        "3": "turn-1deg",
        "4": "turn+1deg",
    }
    taken = list(
        taken_actions(
            commands(iter(["up", "1", "1", "r", "left", *["2"] * 3, "q"]), known), ARM, np.array([95.0, 29.5])
        )
    )
    assert [action for _, action in taken] == [
        (95.0, 30.0),  # no further than its bound
        (85.0, 30.0),
        (75.0, 30.0),
        None,
        (85.0, 29.5),
        (95.0, 29.5),
        (105.0, 29.5),
        (110.0, 29.5),
    ]
    assert [move is None for move, _ in taken] == [action is None for _, action in taken]


def test_the_moves_without_a_key_are_said() -> None:
    assert legend(moves(Discrete(("up", "down", "left", "right")))) == (
        "arrow keys, or 1 up, 2 down, 3 left, 4 right; r starts over, q ends."
    )
    joints = replace(ARM, names=tuple("abcdef"), low=(0.0,) * 6, high=(1.0,) * 6, units=("",) * 6)
    shown = legend(changes(joints, {(5, True): "up", (0, False): "left"}))
    assert shown.startswith("left or 1 a-0.05, 2 a+0.05, 3 b-0.05,")
    assert shown.endswith(", 9 e-0.05, up f+0.05; r starts over, q ends; without a key: e+0.05, f-0.05.")


def test_only_an_import_of_numbers_has_a_command_to_begin_with() -> None:
    states = SimpleNamespace(actions=np.array([[1.0, 2.0], [3.0, 4.0]]))

    def driven(environment: str, actions: Any) -> Driven:
        dataset: Any = SimpleNamespace(recipe=SimpleNamespace(environment=environment), states={7: states}.__getitem__)
        return Driven(run=cast(Any, None), dataset=dataset, actions=actions, episode=7)

    first = driven("imported", ARM).first_command
    assert first is not None
    assert first.tolist() == [1.0, 2.0]
    assert driven("grid_world", ARM).first_command is None

    def gone(_episode: int) -> Any:
        raise LabelsNotAvailable("they are not there.")

    without = driven("imported", ARM)
    without.dataset.states = gone  # type: ignore[method-assign]
    assert without.first_command is not None
    assert without.first_command.tolist() == [10.0, 20.0]
    assert driven("imported", Discrete(("a", "b"))).first_command is None


def test_arrows_take_the_first_two_numbers_to_their_bounds_and_digits_any() -> None:
    spec = Continuous(
        names=("dx", "lift", "turn"), low=(-0.04, 0.01, -1.0), high=(0.03, 0.06, 2.0), units=("m", "m", "rad")
    )
    bound = bindings(moves(spec))
    assert {key: move.action for key, move in bound.items() if not key.isdigit()} == {
        "left": (-0.04, 0.01, 0.0),  # 0 is below what lift can be
        "right": (0.03, 0.01, 0.0),
        "down": (0.0, 0.01, 0.0),
        "up": (0.0, 0.06, 0.0),
    }
    assert [bound[digit].name for digit in "123456"] == [
        "dx=-0.04m",
        "dx=0.03m",
        "lift=0.01m",
        "lift=0.06m",
        "turn=-1rad",
        "turn=2rad",
    ]
    assert bound["6"].action == (0.0, 0.01, 2.0)
    assert set(bindings(moves(Continuous(names=("v",), low=(0.0,), high=(1.0,), units=("",))))) == {
        "left",
        "right",
        "1",
        "2",
    }
