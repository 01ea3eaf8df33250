"""Training: bit for bit the same after a kill, without labels/, and with nothing lost on Ctrl-C."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from walking_square import record_walks

from dmotion_bench.errors import FolderInUse, LabelsNotAvailable, RunCorrupt, RunMismatch, RunMissing
from dmotion_bench.learning import checkpoint
from dmotion_bench.learning.devices import launch
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training import Report, train
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.4", "validations=3", "ema=0.9")


class Stopped(Exception):
    """Raised by a progress callback."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


def _run(data: Path, folder: Path, **request) -> Run:
    return open_run(
        TrainingRequest(model="dmotion", settings=SETTINGS, **request), Dataset.open(data), folder, Workspace(folder)
    )


def _train(run: Run, data: Path, stop_at: int | None = None) -> None:
    def on_step(report: Report) -> None:
        if report.step == stop_at:
            raise Stopped

    train(run, training_data(run, Dataset.open(data)), launch("cpu"), on_step)


@pytest.fixture(scope="module")
def trained(recorded, tmp_path_factory) -> Run:
    run = _run(recorded, tmp_path_factory.mktemp("runs") / "whole")
    _train(run, recorded)
    return run


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_bits(recorded, trained, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.CHECKPOINT_SECONDS", 0.0)
    for stop_at in (2, 5, 6):
        with pytest.raises(Stopped):
            _train(_run(recorded, tmp_path / "run"), recorded, stop_at)
    _train(_run(recorded, tmp_path / "run"), recorded)
    again = Run.open(tmp_path / "run")
    assert again.result["weights"] == trained.result["weights"]
    assert again.result["best_step"] == trained.result["best_step"]
    steps = [json.loads(line)["step"] for line in again.metrics.read_text().splitlines()]
    assert steps == [json.loads(line)["step"] for line in trained.metrics.read_text().splitlines()]


@pytest.mark.slow
def test_a_kill_between_two_checkpoints_loses_neither(recorded, tmp_path, monkeypatch) -> None:
    """Where the phase that needs no labels ends there are two: one to go on from, one for other label budgets."""
    save, written = checkpoint.save, []

    def world(folder: str) -> Run:
        request = TrainingRequest(model="wm-ae", labels="100%", settings=("epochs=0.4", "validations=2"))
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
    _train(whole, recorded)
    kept = written.index("watched.safetensors")
    for place in (kept - 1, kept, kept + 1):
        stop_before(place)
        with pytest.raises(Stopped):
            _train(world(f"{place}"), recorded)
        stop_before(None)
        _train(world(f"{place}"), recorded)
        again = Run.open(tmp_path / f"{place}")
        assert again.result["weights"] == whole.result["weights"]
        tensors, expected = (checkpoint.load(run.watched, required=None)[0] for run in (again, whole))
        assert checkpoint.weights_hash(tensors) == checkpoint.weights_hash(expected)


@pytest.mark.slow
def test_ctrl_c_keeps_the_step_and_the_run_goes_on(recorded, trained, tmp_path) -> None:
    import os
    import signal

    run = _run(recorded, tmp_path / "run")

    def on_step(report: Report) -> None:
        if report.step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(run, training_data(run, Dataset.open(recorded)), launch("cpu"), on_step)
    assert checkpoint.load(run.last)[1]["step"] in (3, 4)
    _train(_run(recorded, tmp_path / "run"), recorded)
    assert Run.open(tmp_path / "run").result["weights"] == trained.result["weights"]


def test_without_the_labels_unsupervised_training_is_the_same_to_the_bit(recorded, trained, tmp_path) -> None:
    bare = tmp_path / "walk-test"
    shutil.copytree(recorded, bare)
    shutil.rmtree(bare / "labels")
    with pytest.raises(LabelsNotAvailable):
        _train(_run(bare, tmp_path / "one-shot"), bare)
    run = _run(bare, tmp_path / "none", labels="none")
    _train(run, bare)
    assert run.result["labels_total"] == 0
    assert trained.result["labels_total"] == 4
    with_labels, without = (dict(model.state_dict()) for model in (trained.model, run.model))
    table = with_labels.pop("table")
    assert not torch.equal(table, without.pop("table"))
    for name, weights in with_labels.items():
        assert torch.equal(weights, without[name]), name


def test_another_seed_gives_other_weights(recorded, trained, tmp_path) -> None:
    run = _run(recorded, tmp_path / "run", seed=1)
    _train(run, recorded)
    assert run.result["weights"] != trained.result["weights"]


def test_the_folder_of_another_request_is_refused_and_says_why(recorded, trained) -> None:
    with pytest.raises(RunMismatch, match="seed is 0 there and 5 here"):
        _run(recorded, trained.path, seed=5)
    with pytest.raises(RunMismatch, match=r"epochs: 0.4.* there and .*epochs: 0.7"):
        open_run(
            TrainingRequest(model="dmotion", settings=(*SETTINGS[:1], "epochs=0.7", *SETTINGS[2:])),
            Dataset.open(recorded),
            trained.path,
            Workspace(trained.path),
        )


def test_a_finished_run_is_not_trained_again(recorded, trained) -> None:
    before = trained.best.read_bytes()
    _train(_run(recorded, trained.path), recorded, stop_at=1)
    assert trained.best.read_bytes() == before


def test_a_run_is_trained_by_one_at_a_time(recorded, tmp_path) -> None:
    run = _run(recorded, tmp_path / "run")
    data = training_data(run, Dataset.open(recorded))

    def train_too(report: Report) -> None:
        with pytest.raises(FolderInUse, match="another dmbench is writing into"):
            _train(_run(recorded, run.path), recorded)
        raise Stopped

    with pytest.raises(Stopped):
        train(run, data, launch("cpu"), train_too)


def test_damaged_runs_are_said_in_a_sentence(trained, tmp_path) -> None:
    with pytest.raises(RunMissing, match="list runs"):
        Run.open(tmp_path)
    copy = tmp_path / "run"
    shutil.copytree(trained.path, copy)
    flipped = bytearray((copy / "best.safetensors").read_bytes())
    flipped[-5] ^= 1
    (copy / "best.safetensors").write_bytes(flipped)
    with pytest.raises(RunCorrupt, match="its checksum is another"):
        _ = Run.open(copy).model
    (copy / "run.json").write_text('{"format": "dmbench-run/9"}')
    with pytest.raises(RunCorrupt, match="dmbench-run/9"):
        Run.open(copy)
    (copy / "run.json").write_text('{"format')
    with pytest.raises(RunCorrupt, match="cannot be read"):
        Run.open(copy)


def test_the_model_predicts_after_a_reload_what_it_did_before(trained) -> None:
    frames = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
    action = torch.tensor([0, 3])
    with torch.no_grad():
        first = trained.model.predict(frames, frames, action)
        second = Run.open(trained.path).model.predict(frames, frames, action)
    assert torch.equal(first, second)
    assert not torch.equal(first[0], first[1])
