"""What ``import dmotion_bench as dm`` offers does what the commands do, and takes texts where paths may stand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from dmbench_command import dmbench

import dmotion_bench as dm
from dmotion_bench.api import demonstration
from dmotion_bench.api.settings import as_texts
from dmotion_bench.errors import FolderInUse, InvalidSetting, RunMissing, UnknownName, UsageError
from dmotion_bench.scoring.score import score_run
from dmotion_bench.storage.lock import FolderLock

SHORT = {"epochs": 0.5}


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*.mcap")}


@pytest.mark.slow
def test_a_recording_has_the_bytes_of_the_command_s(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[dm.JobProgress] = []
    recorded = dm.record(
        "grid_world", "tiny", episodes=4, vary="background", out=str(workspace / "a"), progress=told.append
    )
    words = ["record", "grid_world", "--preset", "tiny", "--episodes", "4", "--vary", "background", "--out", "b"]
    assert dmbench([*words, "--workers", "1"], capsys, monkeypatch).code == 0
    assert recorded.episodes == 4
    assert bytes_of(workspace / "a") == bytes_of(workspace / "b") != {}
    assert (told[-1].done, told[-1].total) == (4, 4)


@pytest.mark.slow
def test_a_training_has_the_weights_of_the_command_s(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[dm.JobProgress] = []
    run = dm.train("lapo", out="runs/a", settings=SHORT, threads=1, progress=told.append)
    words = ["train", "lapo", "--out", "runs/b", "--set", "epochs=0.5", "--threads", "1"]
    assert dmbench(words, capsys, monkeypatch).code == 0
    own, other = run.weights(), dm.load_run("runs/b").weights()
    assert own.keys() == other.keys()
    for name, value in own.items():
        assert torch.equal(value, other[name]), name
    assert told[-1].done == told[-1].total == run.result["steps"]


def test_the_same_call_returns_a_finished_training_and_mends_a_damaged_one(workspace: Path) -> None:
    before = dm.load_run("tiny").weights()
    again = dm.train("dmotion", out="runs/tiny", settings=SHORT, threads=1)
    assert again.result == dm.load_run("tiny").result
    file = next((workspace / "runs" / "tiny").rglob("*.safetensors"))
    file.write_bytes(file.read_bytes()[:100])
    mended = dm.train("dmotion", out="runs/tiny", settings=SHORT, threads=1)
    for name, value in mended.weights().items():
        assert torch.equal(value, before[name]), name


@pytest.mark.slow
def test_another_label_budget_takes_over_the_training_on_video(
    workspace: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", logger="dmotion_bench"):
        run = dm.train("dmotion", labels="2-shot", settings=SHORT, threads=1)
    assert "using the training of runs/tiny, which differs only in its labels and what it does with them" in caplog.text
    assert run.result["labels_total"] == 8


@pytest.mark.slow
def test_what_progress_raises_stops_a_training_that_the_same_call_ends(workspace: Path) -> None:
    class Enough(Exception):
        """The caller's own."""

    def stop(told: dm.JobProgress) -> None:
        if told.done:
            raise Enough

    with pytest.raises(Enough):
        dm.train("lapo", settings=SHORT, out="runs/stopped", threads=1, progress=stop)
    ended = dm.train("lapo", settings=SHORT, out="runs/stopped", threads=1)
    whole = dm.train("lapo", settings=SHORT, out="runs/whole", threads=1)
    for name, value in ended.weights().items():
        assert torch.equal(value, whole.weights()[name]), name


def test_a_run_and_a_data_set_say_what_they_are(workspace: Path) -> None:
    run = dm.load_run("tiny")
    assert repr(run) == "<Run 'tiny': dmotion, labels one-shot, trained>"
    run.manifest["result"] = None
    assert repr(run) == "<Run 'tiny': dmotion, labels one-shot, not trained>"
    assert repr(run.dataset) == "<Dataset 'grid_world-tiny': 20 episodes, 240 frames, grid_world>"


@pytest.mark.slow
def test_a_report_is_that_of_the_command(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RunMissing, match=r"dm\.score"):
        dm.load_run("tiny").report  # noqa: B018
    told: list[dm.JobProgress] = []
    report = dm.score("tiny", ["prediction", "rollout"], horizon=4, progress=told.append)
    outcome = dmbench(
        ["score", "tiny", "--metrics", "prediction,rollout", "--horizon", "4", "--json"], capsys, monkeypatch
    )
    (said,) = json.loads(outcome.out)["reports"]
    assert report.summary() | {"run": "runs/tiny"} == said
    assert dm.load_run("tiny").report.figures == report.figures
    assert told
    with pytest.raises(UnknownName, match="predicton"):
        dm.score("tiny", "predicton")


@pytest.mark.slow
def test_a_task_is_planned_as_the_command_plans_it(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = {"samples": 4, "horizon": 2, "elites": 2, "iterations": 1}
    planned = dm.plan("tiny", 1, steps=3, planner_settings=chosen, save="planned.rrd")
    words = [word for name, value in chosen.items() for word in ("--planner-set", f"{name}={value}")]
    outcome = dmbench(["plan", "tiny", "--task", "1", "--steps", "3", *words, "--json"], capsys, monkeypatch)
    assert json.loads(outcome.out) | {"planning_seconds": 0} == planned.to_json() | {"planning_seconds": 0}
    assert (workspace / "planned.rrd").stat().st_size > 10_000
    with pytest.raises(UsageError, match=r"must end in \.rrd"):
        dm.plan("tiny", save="planned.gif")


@pytest.mark.slow
def test_the_demo_is_done_once_and_leaves_a_workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "EPISODES", 12)
    monkeypatch.setattr(demonstration, "EPOCHS", 0.01)
    lines: list[str] = []
    done = dm.demo(str(tmp_path / "demo"), say=lines.append)
    assert [line[:3] for line in lines if not line.startswith(" ")] == ["1/4", "2/4", "3/4", "4/4"]
    assert dm.open_dataset(workspace=tmp_path / "demo").path == done.dataset
    assert dm.load_run(workspace=str(tmp_path / "demo")).report.figures == done.report.figures
    assert done.recording.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("settings", "texts"),
    [
        (None, ()),
        ({"epochs": 0.5, "n": 3}, ("epochs=0.5", "n=3")),
        ({"on": True, "off": False, "none": None}, ("on=true", "off=false", "none=none")),
        ({"sizes": [1, 2], "name": "x"}, ("sizes=1,2", "name=x")),
        ({"numpy": np.float32(0.5), "torch": torch.tensor(2)}, ("numpy=0.5", "torch=2")),
        (["a=1"], ("a=1",)),
    ],
)
def test_settings_are_written_as_the_command_takes_them(settings: Any, texts: tuple[str, ...]) -> None:
    assert as_texts(settings) == texts


@pytest.mark.parametrize("settings", ["epochs=5", {"x": object()}, {"x": {"y": 1}}, {"x": torch.zeros(2)}])
def test_settings_that_are_none_are_refused(settings: Any) -> None:
    with pytest.raises(InvalidSetting):
        as_texts(settings)


@pytest.mark.slow
def test_a_report_computed_by_the_library_is_the_same(workspace: Path) -> None:
    assert (
        score_run(workspace / "runs" / "tiny", metrics=("prediction",)).figures
        == dm.score("tiny", "prediction").figures
    )


@pytest.mark.slow
def test_a_run_in_use_is_refused(workspace: Path) -> None:
    (workspace / "runs" / "busy").mkdir()
    lock = FolderLock(workspace / "runs" / "busy")
    with pytest.raises(FolderInUse):
        dm.train("lapo", settings=SHORT, out="runs/busy", threads=1)
    lock.release()
    assert dm.train("lapo", settings=SHORT, out="runs/busy", threads=1).result
