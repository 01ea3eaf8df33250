"""Trainings of several phases: each ends by itself, goes on from the best weights, and has its own rows of the log."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from learning.short_training import NARROW, Stopped, train_short

from dmotion_bench.errors import RunCorrupt
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace


def _patient(
    model: str, data: Path, folder: Path, losses: Mapping[int, float], *settings: str, stop_at: int | None = None
) -> Run:
    """A training with made-up validation losses, by step."""
    run = open_run(
        TrainingRequest(
            model=model,
            labels="100%",
            settings=("batch_size=16", "validations=8", "precision=float32", *settings),
        ),
        Dataset.open(data),
        folder,
        Workspace(folder),
    )
    reached = 0

    def on_step(report: StepReport) -> None:
        nonlocal reached
        reached = report.step
        if report.step == stop_at:
            raise Stopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
        patch.setattr("dmotion_bench.learning.training.loop.validation_losses", lambda *_: {"loss": losses[reached]})
        train(run, training_data(run, Dataset.open(data)), launch("cpu"), on_step)
    return Run.open(folder)


@pytest.mark.slow
def test_patience_leaves_out_steps_and_keeps_the_weights_of_the_whole_training(recorded, tmp_path) -> None:
    losses = {1: 3.0, 2: 2.0, 3: 4.0, 4: 4.0, 5: 4.0, 6: 4.0, 7: 4.0, 8: 4.0}
    whole = _patient("ed-cnn", recorded, tmp_path / "whole", losses, "epochs=1.5")
    short = _patient("ed-cnn", recorded, tmp_path / "short", losses, "epochs=1.5", "patience=3")
    assert (whole.result["steps"], whole.result["ended"]) == (8, {})
    assert (short.result["steps"], list(short.result["ended"].values())) == (5, [5])
    assert short.result["triplets"] == 5 * 16
    assert short.result["weights"] == whole.result["weights"]
    assert short.result["best_step"] == 2


@pytest.mark.slow
def test_patience_begins_anew_with_each_phase_and_a_kill_changes_nothing(recorded, tmp_path) -> None:
    losses = {2: 3.0, 4: 2.0, 6: 4.0, 8: 1.0, 10: 9.0, 12: 8.0, 14: 9.0, 16: 1.0}

    def world(folder: str, stop_at: int | None = None) -> Run:
        return _patient(
            "wm-ae", recorded, tmp_path / folder, losses, "epochs=3", "patience=1", *NARROW, stop_at=stop_at
        )

    whole = world("whole")
    assert whole.result["ended"] == {"autoencoder": 6, "transition": 14}
    assert whole.result["steps"] == 6 + 6
    assert whole.result["best_step"] == 12
    for stop_at in (5, 9, 13):  # in the first phase, at the start of the second, and before its end
        with pytest.raises(Stopped):
            world("killed", stop_at)
    again = world("killed")
    for name in ("weights", "ended", "steps", "triplets", "best_step"):
        assert again.result[name] == whole.result[name]


@pytest.mark.slow
@pytest.mark.parametrize("ema", ["0", "0.5"])
def test_a_phase_goes_on_from_the_best_weights_of_the_one_before(recorded, tmp_path, ema: str) -> None:
    losses = {2: 3.0, 4: 2.0, 6: 4.0, 8: 5.0, 10: 9.0, 12: 8.0, 14: 7.0, 16: 6.0}

    def world(stop_at: int | None = None) -> Run:
        return _patient("wm-ae", recorded, tmp_path / "run", losses, "epochs=3", f"ema={ema}", *NARROW, stop_at=stop_at)

    with pytest.raises(Stopped):
        world(stop_at=9)
    best, facts = checkpoint.load(Run.open(tmp_path / "run").best, required=None)
    final, final_facts = checkpoint.load(world().best, required=None)
    assert (facts["step"], final_facts["step"]) == (4, 16)
    code = [name for name in best if "transition" not in name]
    assert len(code) not in (0, len(best))
    for name in code:
        assert torch.equal(final[name], best[name]), name


@pytest.mark.slow
def test_no_row_of_the_log_is_of_two_phases(recorded, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.LOG_ROWS", 3)
    run = open_run(
        TrainingRequest(model="wm-ae", labels="100%", settings=("batch_size=16", "epochs=3", "validations=1", *NARROW)),
        Dataset.open(recorded),
        tmp_path / "run",
        Workspace(tmp_path),
    )
    train_short(run, recorded)

    rows = [json.loads(line) for line in run.metrics.read_text().splitlines()]
    terms = {row["step"]: set(row) & {"reconstruction", "transition"} for row in rows if "loss" in row}
    early, late = {"reconstruction"}, {"transition"}
    assert terms == {5: early, 8: early, 10: late, 15: late, 16: late}


@pytest.mark.slow
def test_a_checkpoint_that_says_where_no_phase_can_have_ended_is_refused(recorded, tmp_path) -> None:
    losses = dict.fromkeys(range(17), 4.0) | {2: 3.0, 10: 3.0}
    words = ("wm-ae", recorded, tmp_path / "run", losses, "epochs=3", "patience=1", *NARROW)
    with pytest.raises(Stopped):
        _patient(*words, stop_at=11)
    run = Run.open(tmp_path / "run")
    tensors, facts = checkpoint.load(run.last, required=None)
    for ended in ({"autoencoder": 99}, {"autoencoder": -1}, {"autoencoder": "4"}, []):
        checkpoint.save(run.last, tensors, {**facts, "ended": ended})
        with pytest.raises(RunCorrupt):
            _patient(*words)
