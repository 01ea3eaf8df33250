"""What ``import dmotion_bench as dm`` offers does what the commands do, and takes texts where paths may stand."""

from __future__ import annotations

import json
import shutil
import urllib.request
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from dmbench_command import dmbench
from torch.utils.data import DataLoader

import dmotion_bench as dm
from dmotion_bench.api import demonstration
from dmotion_bench.api.settings import as_texts
from dmotion_bench.errors import (
    DatasetMissing,
    FolderInUse,
    InvalidSetting,
    LabelsNotAvailable,
    ModelContractBroken,
    RunMismatch,
    RunMissing,
    UnknownName,
    UsageError,
    ViewerError,
)
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import TripletBatch
from dmotion_bench.planning.objectives.base import Memoryless, StepCost
from dmotion_bench.planning.solvers.base import Plan
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.registry import model_class
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
    assert "using the training of runs/tiny, which differs only in its labels" in caplog.text
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


def test_triplets_are_three_consecutive_frames_of_the_split(workspace: Path) -> None:
    dataset = dm.open_dataset(str(workspace / "data" / "grid_world-tiny"))
    for split in ("train", "validation", "test"):
        triplets = dataset.triplets(split)
        assert len(triplets) == 10 * len(dataset.split(split))
        place = len(triplets) // 2
        sample = triplets[place]
        episode, step = int(triplets.triplets.episode[place]), int(triplets.triplets.step[place])
        assert episode in dataset.split(split).tolist()
        frames = to_model(torch.from_numpy(dataset.video(episode)[step - 1 : step + 2]))
        shown = torch.stack([sample["previous"], sample["current"], sample["next"]])
        assert torch.equal(shown, frames)
        assert sample.keys() == {"previous", "current", "next", "episode"}
        assert torch.equal(triplets[place - len(triplets)]["next"], sample["next"])
        with pytest.raises(IndexError):
            triplets[len(triplets)]


@pytest.mark.slow
def test_a_plain_data_loader_makes_batches_that_a_model_learns_from(workspace: Path) -> None:
    triplets = dm.open_dataset().triplets("train", labels="all")
    batch = next(iter(DataLoader(triplets, batch_size=4, shuffle=False)))
    kind = model_class("ed-cnn")
    run = dm.train("ed-cnn", labels="all", settings={"epochs": 0.1})
    losses = run.model.losses(TripletBatch(**batch))
    assert torch.isfinite(losses.total)
    assert isinstance(run.model, kind)
    assert batch["action"].tolist() == triplets.actions[:4].tolist()  # type: ignore[index]


def test_labels_of_triplets_are_those_that_the_budget_pays_for(workspace: Path) -> None:
    dataset = dm.open_dataset()
    triplets = dataset.triplets("train", labels=16, seed=3)
    paid = LabelBudget(dataset, LabelRequest.parse("16"), 3).actions(TripletSet.of_split(dataset, "train"), "training")
    assert triplets.actions is not None
    assert np.array_equal(triplets.actions, paid.actions)
    for place in range(len(triplets)):
        episode, step = int(triplets.triplets.episode[place]), int(triplets.triplets.step[place])
        assert triplets[place]["action"] == dataset.labels(episode).actions[step]
    with pytest.raises(UsageError, match="labels no model may learn from"):
        dataset.triplets("test", labels="all")
    with pytest.raises(UnknownName, match="no split named 'tset'"):
        dataset.triplets("tset")  # type: ignore[arg-type]


def test_no_labels_and_demonstrations_are_asked_for_in_python_s_words(workspace: Path) -> None:
    dataset = dm.open_dataset()
    for split in ("train", "test"):
        assert dataset.triplets(split, labels="none")[0].keys() == {"previous", "current", "next", "episode"}
        assert len(dataset.triplets(split, labels="none")) == len(dataset.triplets(split))
    with pytest.raises(LabelsNotAvailable, match=r"labels='one-shot' are demonstrations.*or labels=\"all\"\."):
        dataset.triplets("train", labels="one-shot")


def test_video_alone_is_read_where_there_are_no_labels(workspace: Path) -> None:
    for file in (workspace / "data" / "grid_world-tiny" / "labels").glob("*"):
        file.unlink()
    assert len(dm.open_dataset().triplets("train")) > 0
    with pytest.raises(LabelsNotAvailable):
        dm.open_dataset().triplets("train", labels="all")


def test_a_run_predicts_stored_frames_as_its_model_predicts_images(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    names = run.dataset.spec.actions.names  # type: ignore[union-attr]
    before, now = (to_model(torch.from_numpy(frames[step][None])) for step in (0, 1))
    with torch.inference_mode():
        expected = run.model.predict(before, now, torch.tensor([2]))
    assert torch.equal(run.predict(before, now, names[2]), expected)
    shown = run.predict(frames[0], frames[1], names[2])
    assert isinstance(shown, np.ndarray)
    assert shown.dtype == np.uint8
    assert (to_model(torch.from_numpy(shown)) - expected.clamp(-1, 1)).abs().max() <= 1 / 127.5
    assert np.array_equal(shown, run.predict(frames[0], frames[1], 2))


def test_images_that_a_model_would_take_wrongly_are_refused(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = torch.from_numpy(run.dataset.video(0))
    before, now = (to_model(frames[step][None]) for step in (0, 1))
    same = run.predict(before, now, "up")
    for kind in (torch.float64, torch.float16):
        assert torch.allclose(run.predict(before.to(kind), now.to(kind), "up"), same, atol=0.01)
    raw = frames[1][None].movedim(-1, 1).float()
    for wrong, says in ((raw, "values from 0 to 25"), (now * torch.nan, "values from nan to nan")):
        for call in (lambda one: run.predict(before, one, "up"), lambda one: run.latent_action(before, now, one)):
            with pytest.raises(UsageError, match=says):
                call(wrong)
    with pytest.raises(UsageError, match=r"DMotion\.predict\(\) was given batches of 1, 2 images"):
        run.predict(frames[0], frames[:2], "up")
    with pytest.raises(UsageError, match=r"there are no images: they were given with the shape \(0, "):
        run.predict(frames[:0], frames[:0], "up")


@pytest.mark.slow
def test_a_rollout_begins_with_the_prediction_and_takes_a_sequence_for_each(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    together = run.rollout(frames[:2], frames[1:3], [["up", "left"], ["down", "left"]])
    assert together.shape == (2, 2, 128, 128, 3)
    for row, name in enumerate(("up", "down")):
        alone = run.rollout(frames[row], frames[row + 1], [name, "left"])
        assert np.abs(alone.astype(int) - together[row].astype(int)).max() <= 1  # sums of another order
        first = run.predict(frames[row], frames[row + 1], name)
        assert np.abs(first[0].astype(int) - together[row, 0].astype(int)).max() <= 1
    with pytest.raises(UnknownName, match="did you mean 'up'"):
        run.predict(frames[0], frames[1], "upp")


def _run_of(workspace: Path) -> dm.Run:
    """The run, trained on the data set of this workspace alone."""
    run = dm.load_run("tiny")
    run.manifest["dataset_path"] = "data/grid_world-tiny"
    run.write()
    return run


@pytest.mark.slow
def test_a_run_predicts_by_the_names_that_it_keeps_without_its_data_set(workspace: Path) -> None:
    run = _run_of(workspace)
    frames = run.dataset.video(0)
    left = run.predict(frames[0], frames[1], "left")
    shutil.rmtree(workspace / "data")
    alone = dm.load_run("tiny")
    assert np.array_equal(alone.predict(frames[0], frames[1], "left"), left)
    assert alone.rollout(frames[0], frames[1], ["left", "up"]).shape == (1, 2, 128, 128, 3)
    del alone.manifest["action_names"]  # as in a run of before
    alone.write()
    before = dm.load_run("tiny")
    assert np.array_equal(before.predict(frames[0], frames[1], "2"), left)
    with pytest.raises(DatasetMissing):
        before.predict(frames[0], frames[1], "left")


@pytest.mark.slow
def test_another_data_set_in_the_place_of_a_run_s_own_is_noticed(workspace: Path) -> None:
    run = _run_of(workspace)
    frames = run.dataset.video(0)
    expected = run.predict(frames[0], frames[1], "left")
    shutil.rmtree(workspace / "data" / "grid_world-tiny")
    dm.record("grid_world", "tiny", seed=1, episodes=4, out="data/grid_world-tiny")
    with pytest.raises(RunMismatch, match=r"has changed since the run 'tiny' was trained on it; open it as it is now"):
        _ = run.dataset
    assert np.array_equal(run.predict(frames[0], frames[1], "left"), expected)
    del run.manifest["action_names"]
    with pytest.raises(RunMismatch, match="has changed"):
        run.predict(frames[0], frames[1], "left")


def test_actions_of_tensors_are_checked(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    for number in (-1, 99):
        with pytest.raises(UsageError, match=f"given action {number} in row 0; there are 4"):
            run.predict(frames[0], frames[1], torch.tensor([number]))
        with pytest.raises(UsageError, match=f"given action {number} in row 1; there are 4"):
            run.rollout(frames[0], frames[1], torch.tensor([[0, number]]))


@pytest.mark.slow
def test_a_model_that_was_first_asked_for_a_prediction_can_be_trained_further(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    run.predict(frames[0], frames[1], "up")
    batch = next(iter(DataLoader(run.dataset.triplets("train"), batch_size=4)))
    run.model.train().losses(TripletBatch(**batch)).total.backward()
    assert any(one.grad is not None and bool(one.grad.any()) for one in run.model.parameters())
    with torch.inference_mode():
        other = dm.load_run("tiny").model
    assert not any(one.is_inference() for one in (*other.parameters(), *other.buffers()))


def test_a_run_and_a_data_set_say_what_they_are(workspace: Path) -> None:
    run = dm.load_run("tiny")
    assert repr(run) == "<Run 'tiny': dmotion, labels one-shot, trained>"
    run.manifest["result"] = None
    assert repr(run) == "<Run 'tiny': dmotion, labels one-shot, not trained>"
    assert repr(run.dataset) == "<Dataset 'grid_world-tiny': 20 episodes, 240 frames, grid_world>"


@pytest.mark.slow
def test_latent_actions_are_the_model_s_and_not_every_model_has_them(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    images = [to_model(torch.from_numpy(frames[step : step + 1])) for step in range(3)]
    model: Any = run.model
    with torch.inference_mode():
        expected = model.latent_action(*images)
    assert np.array_equal(run.latent_action(*frames[:3]), expected.numpy())
    other = dm.train("ed-cnn", labels="all", settings={"epochs": 0.1})
    with pytest.raises(UsageError, match="'ed-cnn' has no latent actions"):
        other.latent_action(*frames[:3])


@pytest.mark.slow
def test_a_run_without_labels_says_how_to_tell_it_the_actions(workspace: Path) -> None:
    run = dm.train("dmotion", labels="none", settings=SHORT, threads=1)
    frames = run.dataset.video(0)
    with pytest.raises(LabelsNotAvailable, match="--labels"):
        run.predict(frames[0], frames[1], "up")
    assert run.latent_action(*frames[:3]).shape == (1, 2)


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
def test_views_are_written_to_files(workspace: Path) -> None:
    assert dm.view(dm.load_run("tiny"), save="run.rrd", episodes=[0]) == Path("run.rrd")
    assert dm.view("tiny", save="run.gif", steps=2, episodes=[0]) == Path("run.gif")
    assert dm.view([str(workspace / "runs" / "tiny")], save=workspace / "again.rrd", episodes=[0])
    for name in ("run.rrd", "run.gif", "again.rrd"):
        assert (workspace / name).stat().st_size > 1000


def test_a_page_is_served_until_it_is_closed(workspace: Path) -> None:
    page = dm.view("grid_world-tiny", web=True, episodes=[0])
    assert isinstance(page, dm.Served)
    with page, urllib.request.urlopen(page.url, timeout=30) as answer:
        assert answer.status == 200
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(page.url, timeout=5)


@pytest.mark.parametrize(
    ("asked", "kind", "said"),
    [
        ({"what": "tiny", "save": "x.png"}, UsageError, "must end in .rrd"),
        ({"what": "tiny", "steps": 3}, UsageError, "steps is for an animation"),
        ({"what": "tinny", "save": "x.rrd"}, UnknownName, "did you mean 'tiny'"),
        ({"what": [], "save": "x.rrd"}, UsageError, "nothing is named"),
        ({"what": "grid_world-tiny", "save": "x.gif"}, UsageError, "name runs"),
        ({"what": ["tiny", "grid_world-tiny"], "save": "x.rrd"}, UsageError, "only runs can be shown side by side"),
        ({"what": "tiny"}, ViewerError, "no display"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    workspace: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], kind: type[Exception], said: str
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(kind, match=said.replace(".", r"\.")):
        dm.view(**asked)
    assert not list(workspace.glob("x.*"))


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


@pytest.mark.slow
def test_a_model_of_a_notebook_is_trained_and_scored_by_its_name(
    workspace: Path, caplog: pytest.LogCaptureFixture
) -> None:
    kind = model_class("ed-cnn")
    dm.register_model("mine", type("Mine", (kind,), {"__doc__": "E-D CNN under another name."}))
    run = dm.train("mine", labels="all", settings={"epochs": 0.1}, threads=1)
    same = dm.train("ed-cnn", labels="all", settings={"epochs": 0.1}, threads=1)
    assert "mine" in dm.model_names()
    figures = [dm.score(one, "prediction").figures["mse"] for one in (run, same)]
    assert figures[0] == figures[1]
    wrong = type("Wrong", (kind,), {"predict": lambda self, previous, current, action: current[:, :1]})
    dm.register_model("wrong", wrong)
    with pytest.raises(ModelContractBroken, match=r"Wrong: predict\(previous, current, action\) gave the shape"):
        dm.train("wrong", labels="all", settings={"epochs": 0.1}, threads=1)
    odd = type("Odd", (kind,), {"predict": lambda self, previous, current, action: current + torch.rand(())})
    dm.register_model("odd", odd)
    assert dm.train("odd", labels="all", settings={"epochs": 0.1}, threads=1).result["labels_total"] > 0
    assert "predict differs from one call to the next" in caplog.text
    with pytest.raises(UsageError, match="registered by a package already"):
        dm.register_model("dmotion", kind)
    for name in ("", "../mine", "a/b", "a b", "-a", "a" * 101):
        with pytest.raises(UsageError, match="cannot be a name here"):
            dm.register_model(name, kind)
    with pytest.raises(UsageError, match="no class of models"):
        dm.register_model("other", object)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"model is <class .*; give a name.* once dm\.register_model was called"):
        dm.train(kind)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="has no 'recording'"):
        dm.register_environment("other", kind)  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class Always:
    """A solver that takes one action, and an objective of which every state costs as much."""

    number: int = 1

    def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Plan:
        tree = PrefixTree(dynamics, evaluator, context.observation, 1)
        best = np.full((len(context.generators), 1, 1), self.number)
        costs = tree.costs(best).min(axis=2)
        return tree.plan(best, costs, [costs[:, 0]])

    def reset(self, spec: Any, first: Any, goals: Any) -> Any:
        return _Indifferent()


class _Indifferent(Memoryless):
    def step(self, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
        return StepCost.of(torch.zeros(len(task))), ()


@pytest.mark.slow
def test_a_planner_of_a_notebook_plans_and_scores_by_its_name(workspace: Path) -> None:
    dm.register_solver("always", Always)
    dm.register_objective("indifferent", Always)
    planned = dm.plan("oracle", steps=2, planner="always", objective="indifferent", planner_settings={"number": 3})
    assert planned.actions == ["right", "right"]
    report = dm.score("tiny", "control", tasks=1, planner="always", objective="indifferent")
    assert report.settings["control_planner"] == "always"
    with pytest.raises(UsageError, match=r"planner is Always\(number=1\); give a name.*dm\.register_solver was called"):
        dm.plan("oracle", planner=Always())  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"objective is <class .*; give a name.*dm\.register_objective was called"):
        dm.score("tiny", "control", objective=Always)  # type: ignore[arg-type]
    for register, many, method in (
        (dm.register_solver, "solvers", "plan"),
        (dm.register_objective, "objectives", "reset"),
    ):
        thawed = make_dataclass("Thawed", [("number", int, 1)], namespace={method: getattr(Always, method)})
        for wrong in (object, _Indifferent, Always(), dm.JobProgress, thawed):
            with pytest.raises(UsageError, match=f"is no class of {many}; give a frozen dataclass .* '{method}'"):
                register("other", wrong)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="cannot be a name here"):
            register("a b", Always)
    with pytest.raises(UsageError, match="registered by a package already"):
        dm.register_solver("cem", Always)
    with pytest.raises(UsageError, match="registered by a package already"):
        dm.register_objective("pixel", Always)
    with pytest.raises(UnknownName, match="where register_solver was called"):
        dm.plan("oracle", planner="xyzzy")


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
