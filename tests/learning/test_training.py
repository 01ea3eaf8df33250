"""Training: bit for bit the same after a kill, without labels/, and with nothing lost on Ctrl-C."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from learning.short_training import NARROW, SETTINGS, Stopped, short_run, train_short

from dmotion_bench.errors import LabelsNotAvailable, ModelContractBroken
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.figures import StepFigures
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.resuming import NextRow
from dmotion_bench.learning.training.state import StepReport, TrainingState
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_bits(recorded, trained, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
    for stop_at in (2, 5, 6):
        with pytest.raises(Stopped):
            train_short(short_run(recorded, tmp_path / "run"), recorded, stop_at)
    train_short(short_run(recorded, tmp_path / "run"), recorded)
    again = Run.open(tmp_path / "run")
    assert again.result["weights"] == trained.result["weights"]
    assert again.result["best_step"] == trained.result["best_step"]
    steps = [json.loads(line)["step"] for line in again.metrics.read_text().splitlines()]
    assert steps == [json.loads(line)["step"] for line in trained.metrics.read_text().splitlines()]


@pytest.mark.slow
def test_a_kill_between_two_rows_of_the_log_changes_neither(recorded, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("dmotion_bench.learning.training.loop.LOG_ROWS", 2)
    few = ("batch_size=16", "epochs=1.5", "validations=2", "precision=float32")

    def rows_of(name: str, *stops: int) -> list[dict[str, float]]:
        for stop_at in (*stops, None):
            request = TrainingRequest(model="ed-cnn", labels="100%", settings=few)
            run = open_run(request, Dataset.open(recorded), tmp_path / name, Workspace(tmp_path))
            with contextlib.suppress(Stopped):
                train_short(run, recorded, stop_at)
        rows = [json.loads(line) for line in (tmp_path / name / "metrics.jsonl").read_text().splitlines()]
        return [{key: row[key] for key in row if key not in ("seconds", "triplets_per_s")} for row in rows]

    whole = rows_of("whole")
    assert [row["step"] for row in whole if "loss" in row] == [4, 8]
    assert rows_of("killed", 3, 7) == whole


def test_a_row_that_no_checkpoint_can_hold_is_left_out_of_it() -> None:
    state = TrainingState(step=1)
    small = NextRow(sums={"loss": 0.5}, steps=1)
    assert state.facts(small).row == small
    for sums in ({"loss": math.nan}, {f"{number:0300}": 1.0 for number in range(200)}):
        assert state.facts(NextRow(sums=sums, steps=1)).row == NextRow()


@pytest.mark.slow
def test_a_kill_between_two_checkpoints_loses_neither(recorded, tmp_path, monkeypatch) -> None:
    """Where the phase that needs no labels ends there are two: one to go on from, one for other label budgets."""
    save, written = checkpoint.save, []

    def world(folder: str) -> Run:
        request = TrainingRequest(model="wm-ae", labels="100%", settings=("epochs=0.4", "validations=2", *NARROW))
        return open_run(request, Dataset.open(recorded), tmp_path / folder, Workspace(tmp_path))

    def stop_before(place: int | None) -> None:
        def count_and_save(path: Path, *rest) -> None:
            written.append(path.name)
            if len(written) - 1 == place:
                raise Stopped
            save(path, *rest)

        written.clear()
        monkeypatch.setattr(checkpoint, "save", count_and_save)

    stop_before(None)
    whole = world("whole")
    train_short(whole, recorded)
    kept = written.index("watched.safetensors")
    for place in (kept - 1, kept, kept + 1):
        stop_before(place)
        with pytest.raises(Stopped):
            train_short(world(f"{place}"), recorded)
        stop_before(None)
        train_short(world(f"{place}"), recorded)
        again = Run.open(tmp_path / f"{place}")
        assert again.result["weights"] == whole.result["weights"]
        tensors, expected = (checkpoint.load(run.unlabelled_stage, required=None)[0] for run in (again, whole))
        assert checkpoint.weights_hash(tensors) == checkpoint.weights_hash(expected)


@pytest.mark.slow
def test_ctrl_c_keeps_the_step_and_the_run_goes_on(recorded, trained, tmp_path) -> None:
    import os
    import signal

    run = short_run(recorded, tmp_path / "run")

    def on_step(report: StepReport) -> None:
        if report.step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(run, training_data(run, Dataset.open(recorded)), launch("cpu"), on_step)
    assert checkpoint.load(run.last)[1]["step"] in (3, 4)
    train_short(short_run(recorded, tmp_path / "run"), recorded)
    assert Run.open(tmp_path / "run").result["weights"] == trained.result["weights"]


@pytest.mark.slow
def test_without_the_labels_unsupervised_training_is_the_same_to_the_bit(recorded, trained, tmp_path) -> None:
    bare = tmp_path / "walk-test"
    shutil.copytree(recorded, bare)
    shutil.rmtree(bare / "labels")
    with pytest.raises(LabelsNotAvailable):
        train_short(short_run(bare, tmp_path / "one-shot"), bare)
    run = short_run(bare, tmp_path / "none", labels="none")
    train_short(run, bare)
    assert run.result["labels_total"] == 0
    assert trained.result["labels_total"] == 4
    with_labels, without = (dict(model.state_dict()) for model in (trained.model, run.model))
    table = with_labels.pop("table")
    assert not torch.equal(table, without.pop("table"))
    for name, weights in with_labels.items():
        assert torch.equal(weights, without[name]), name


@pytest.mark.slow
def test_another_seed_gives_other_weights(recorded, trained, tmp_path) -> None:
    run = short_run(recorded, tmp_path / "run", seed=1)
    train_short(run, recorded)
    assert run.result["weights"] != trained.result["weights"]


def test_the_model_predicts_after_a_reload_what_it_did_before(trained) -> None:
    frames = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
    action = torch.tensor([0, 3])
    with torch.no_grad():
        first = trained.model.predict(frames, frames, action)
        second = Run.open(trained.path).model.predict(frames, frames, action)
    assert torch.equal(first, second)
    assert not torch.equal(first[0], first[1])


@pytest.mark.parametrize("each", [-1.0, math.inf, math.nan])
def test_losses_of_triplets_that_nothing_can_be_drawn_by_end_the_training(
    recorded, tmp_path, monkeypatch, each
) -> None:
    monkeypatch.setattr(StepFigures, "per_triplet", property(lambda self: np.array([0, 1, each, 2], np.float32)))
    asked = TrainingRequest(model="dmotion", settings=(*SETTINGS, "hard_share=0.5"))
    run = open_run(asked, Dataset.open(recorded), tmp_path / "run", Workspace(tmp_path))
    with pytest.raises(
        ModelContractBroken, match=rf"DMotion: losses\(batch\)\.per_triplet holds {each} at step 1; it is"
    ):
        train_short(run, recorded)


def test_of_a_training_that_diverges_no_loss_of_a_triplet_is_kept(recorded, tmp_path, monkeypatch) -> None:
    nothing = np.full(4, np.nan, np.float32)
    monkeypatch.setattr(StepFigures, "per_triplet", property(lambda self: nothing))
    monkeypatch.setattr(StepFigures, "terms", property(lambda self: {"loss": math.nan}))
    asked = TrainingRequest(model="dmotion", settings=(*SETTINGS, "hard_share=0.5"))
    run = open_run(asked, Dataset.open(recorded), tmp_path / "run", Workspace(tmp_path))
    with pytest.raises(Stopped):  # the next validation says what is wrong
        train_short(run, recorded, stop_at=2)


@pytest.mark.parametrize(("told", "said"), [(None, True), (np.ones(4, np.float32), False)])
def test_a_share_of_hard_triplets_that_nothing_tells_is_said(
    recorded, tmp_path, monkeypatch, caplog, told, said
) -> None:
    monkeypatch.setattr(StepFigures, "per_triplet", property(lambda self: told))
    asked = TrainingRequest(model="dmotion", settings=(*SETTINGS, "hard_share=0.5"))
    run = open_run(asked, Dataset.open(recorded), tmp_path / "run", Workspace(tmp_path))
    with pytest.raises(Stopped):
        train_short(run, recorded, stop_at=2)
    sentence = "DMotion: losses(batch) gives no per_triplet, so hard_share draws nothing by it and changes nothing."
    assert [record.getMessage() for record in caplog.records] == [sentence] * said
