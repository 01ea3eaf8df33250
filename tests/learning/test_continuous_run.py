"""From a recording with continuous actions to a report: DMotion with 64 labels, E-D CNN with all of them."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from dmotion_bench.errors import DmbenchError, InvalidSetting, RunMismatch, UsageError
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, resolve, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.report import read_report
from dmotion_bench.scoring.samples import column, read_samples, vectors
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

pytestmark = pytest.mark.slow

SETTINGS = ("epochs=0.5", "batch_size=8", "validations=2")


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    workspace = Workspace(tmp_path_factory.mktemp("workspace"))
    for kind in ("continuous", "discrete"):
        recipe = DatasetRecipe(
            environment="robot_push", parameters={"actions": kind}, policy="push", episodes=20, frames=10
        )
        record_dataset(workspace.data / f"{kind}-tiny", recipe)
    return workspace


def _trained(workspace: Workspace, model: str, labels: str | None, data: str = "continuous-tiny") -> Run:
    dataset = Dataset.open(workspace.data / data)
    request = TrainingRequest(model=model, labels=labels, preset=Preset.TINY, settings=SETTINGS)
    run = open_run(request, dataset, None, workspace)
    if run.result is None:
        train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
    return Run.open(run.path)


def test_dmotion_is_told_by_64_transitions_and_scored(workspace: Workspace) -> None:
    run = _trained(workspace, "dmotion", None)
    dataset = Dataset.open(run.dataset_path)
    assert run.spec.labels == "64"
    assert run.path.name.startswith("dmotion-continuous-tiny-")
    assert run.spec.inputs.actions == dataset.spec.actions
    assert run.result is not None
    assert run.result["labels_total"] == run.result["labels"]["demonstrations"]
    assert 8 < run.result["labels_total"] <= 64
    assert run.model.table.rows.shape == (3, 2)  # a middle and a slope for each number
    assert run.model.table.rows.any()

    report = score_run(run.path, settings=ScoreSettings(horizon=3, resamples=50))
    figures = report.figures
    for name in (
        "mse",
        "rollout_mse[3]",
        "motion_probe_error",
        "motion_swap_change",
        "agent_iou",
        "motion_shift_error",
    ):
        assert math.isfinite(figures[name]["mean"]), name
    assert "motion_probe_accuracy" not in figures
    assert "motion_within_over_between" not in figures
    assert report == read_report(run.path / "report")

    samples = read_samples(run.path / "report" / "samples.parquet")
    mine = samples.filter((column(samples, "predictor") == "model") & (column(samples, "metric") == "prediction"))
    commands, episode, step = vectors(mine, "command"), column(mine, "episode"), column(mine, "step")
    assert mine["action"].null_count == len(mine)
    for row in range(0, len(mine), 7):
        np.testing.assert_array_equal(commands[row], dataset.labels(int(episode[row])).actions[step[row]])
    np.testing.assert_allclose(column(mine, "mse").mean(), figures["mse"]["mean"], rtol=1e-6)


def test_another_number_of_labels_takes_the_training_over(workspace: Workspace) -> None:
    from dmotion_bench.learning.training.shared_pretraining import take_over

    first = _trained(workspace, "dmotion", "64")
    dataset = Dataset.open(first.dataset_path)
    request = TrainingRequest(model="dmotion", labels="4", preset=Preset.TINY, settings=SETTINGS)
    run = open_run(request, dataset, None, workspace)
    source = take_over(run)
    assert source is not None
    assert source.name == first.name
    train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
    weights, others = Run.open(run.path).weights(), first.weights()
    assert run.result is not None
    assert run.result["labels_total"] == 4
    assert {name for name in weights if not np.array_equal(weights[name], others[name])} == {"table"}


def test_ed_cnn_learns_from_all_labels_and_is_scored(workspace: Workspace) -> None:
    run = _trained(workspace, "ed-cnn", "all")
    assert run.spec.labels == "100%"
    report = score_run(run.path, settings=ScoreSettings(horizon=2, resamples=50))
    assert math.isfinite(report.figures["mse"]["mean"])
    frames = Dataset.open(run.dataset_path).video(0)
    far, near = (run.model.predict(frames[:1], frames[1:2], [[dx, 0.0]]) for dx in (0.045, -0.045))
    assert not np.array_equal(far, near)


def test_ed_cnn_pays_for_no_more_than_its_number(workspace: Workspace) -> None:
    run = _trained(workspace, "ed-cnn", "16")
    assert run.result is not None
    assert run.result["labels"] == {"training": 14, "validation": 2}


def test_a_continuous_run_does_not_fit_discrete_data_and_the_other_way_round(workspace: Workspace) -> None:
    runs = {
        "continuous": _trained(workspace, "dmotion", None),
        "discrete": _trained(workspace, "dmotion", None, "discrete-tiny"),
    }
    for kind, other in (("continuous", "discrete"), ("discrete", "continuous")):
        with pytest.raises(RunMismatch, match=f"the actions of '{other}-tiny' are"):
            score_run(runs[kind].path, data=workspace.data / f"{other}-tiny")
        assert not list((runs[kind].path / "report").glob("on/*"))


def test_what_counts_single_actions_is_refused_and_nothing_is_begun(workspace: Workspace) -> None:
    dataset = Dataset.open(workspace.data / "continuous-tiny")
    before = {path.parent for path in workspace.runs.glob("*/run.json")}
    with pytest.raises(UsageError, match=r"cannot be counted one by one; give a number .* --labels 64"):
        resolve(TrainingRequest(model="dmotion", labels="one-shot"), dataset)
    clustered = TrainingRequest(model="dmotion", labels="64", settings=("adaptation=clustered",))
    with pytest.raises(UsageError, match=r"adaptation=clustered' is for named actions"):
        resolve(clustered, dataset)
    assert {path.parent for path in workspace.runs.glob("*/run.json")} == before


def test_an_action_outside_its_bounds_is_a_sentence(workspace: Workspace) -> None:
    run = _trained(workspace, "dmotion", None)
    frames = Dataset.open(run.dataset_path).video(0)
    with pytest.raises(UsageError, match=r"'dx' = 0.1 in row 0; it can be -0.045 to 0.045 m"):
        run.model.predict(frames[:1], frames[1:2], [0.1, 0.0])


def test_a_run_whose_actions_cannot_be_is_refused(workspace: Workspace, tmp_path: Path) -> None:
    run = _trained(workspace, "dmotion", None)
    for change, said in (({"low": [1.0, 0.0]}, "below the upper"), ({"names": ["dx"]}, "as many of each")):
        content = json.loads((run.path / "run.json").read_text())
        content["spec"]["actions"].update(change)
        (tmp_path / "run.json").write_text(json.dumps(content))
        with pytest.raises(DmbenchError, match=said):
            Run.open(tmp_path)
    with pytest.raises(InvalidSetting, match="the actions are"):
        dataclasses.replace(run.spec, actions={})
