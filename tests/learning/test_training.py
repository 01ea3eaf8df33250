"""Training: bit for bit the same after a kill, without labels/, and with nothing lost on Ctrl-C."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from killed_writes import Killed, each_kill, killed_at
from walking_square import record_walks

from dmotion_bench.api.training import begin, complete
from dmotion_bench.errors import (
    FolderInUse,
    LabelsNotAvailable,
    ModelContractBroken,
    RunCorrupt,
    RunMismatch,
    RunMissing,
)
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, default_path, open_run, resolve, training_data
from dmotion_bench.learning.training.beginning import finished_result
from dmotion_bench.learning.training.figures import StepFigures
from dmotion_bench.learning.training.loop import Report, train
from dmotion_bench.learning.training.resuming import NextRow
from dmotion_bench.learning.training.shared_pretraining import take_over
from dmotion_bench.learning.training.state import TrainingState
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import held
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.4", "validations=3", "ema=0.9")
NARROW = ("latent=32", "hidden=32")
"""Settings of WM-AE: with its wide layers, most of such a training would be to write their weights."""


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


@pytest.mark.parametrize(
    ("model", "labels", "name"),
    [
        ("dmotion", None, "dmotion-walk-test-small-s0"),
        ("dmotion", "100%", "dmotion-walk-test-small-100pct-s0"),
        ("idm-ed-cnn", "100%", "idm-ed-cnn-walk-test-small-100pct-s0"),
        ("ed-cnn", "100%", "ed-cnn-walk-test-small-s0"),
        ("ed-cnn", "64", "ed-cnn-walk-test-small-64-s0"),
    ],
)
def test_each_budget_has_a_folder_of_its_own(recorded, tmp_path, model, labels, name) -> None:
    request = TrainingRequest(model=model, labels=labels)
    spec = resolve(request, Dataset.open(recorded))
    assert default_path(request, spec, Workspace(tmp_path)) == tmp_path / "runs" / name


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        (("epochs=3",), "dmotion-walk-test-small-epochs_3-s0"),
        (("epochs={epochs}",), "dmotion-walk-test-small-s0"),
        (("learning_rate={learning_rate}", "epochs=3"), "dmotion-walk-test-small-epochs_3-s0"),
        (("warp=true",), "dmotion-walk-test-small-warp_true-s0"),
        (("warp=False",), "dmotion-walk-test-small-s0"),
    ],
)
def test_a_setting_that_the_model_takes_anyway_has_no_folder_of_its_own(recorded, tmp_path, settings, name) -> None:
    usual = resolve(TrainingRequest(model="dmotion"), Dataset.open(recorded))
    request = TrainingRequest(model="dmotion", settings=tuple(one.format(**usual.training) for one in settings))
    spec = resolve(request, Dataset.open(recorded))
    assert default_path(request, spec, Workspace(tmp_path)) == tmp_path / "runs" / name
    assert (spec == usual) == name.endswith("small-s0")


def test_a_run_that_was_named_by_such_a_setting_is_found_again(recorded, tmp_path) -> None:
    request = TrainingRequest(model="dmotion", settings=("warp=false",))
    spec = resolve(request, Dataset.open(recorded))
    before = tmp_path / "runs" / "dmotion-walk-test-small-warp_false-s0"
    before.mkdir(parents=True)
    assert default_path(request, spec, Workspace(tmp_path)).name == "dmotion-walk-test-small-s0"
    (before / "run.json").touch()
    assert default_path(request, spec, Workspace(tmp_path)) == before


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_bits(recorded, trained, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
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
def test_a_kill_between_two_rows_of_the_log_changes_neither(recorded, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("dmotion_bench.learning.training.loop.LOG_ROWS", 2)
    few = ("batch_size=16", "epochs=1.5", "validations=2", "precision=float32")

    def rows_of(name: str, *stops: int) -> list[dict[str, float]]:
        for stop_at in (*stops, None):
            request = TrainingRequest(model="ed-cnn", labels="100%", settings=few)
            run = open_run(request, Dataset.open(recorded), tmp_path / name, Workspace(tmp_path))
            with contextlib.suppress(Stopped):
                _train(run, recorded, stop_at)
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
        tensors, expected = (checkpoint.load(run.unlabelled_stage, required=None)[0] for run in (again, whole))
        assert checkpoint.weights_hash(tensors) == checkpoint.weights_hash(expected)


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

    def on_step(report: Report) -> None:
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
    _train(run, recorded)

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


@pytest.mark.slow
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


@pytest.mark.slow
def test_another_seed_gives_other_weights(recorded, trained, tmp_path) -> None:
    run = _run(recorded, tmp_path / "run", seed=1)
    _train(run, recorded)
    assert run.result["weights"] != trained.result["weights"]


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_run_is_trained_by_one_at_a_time(recorded, tmp_path) -> None:
    run = _run(recorded, tmp_path / "run")
    data = training_data(run, Dataset.open(recorded))

    def train_too(report: Report) -> None:
        with pytest.raises(FolderInUse, match="another dmbench is writing into"):
            _train(_run(recorded, run.path), recorded)
        raise Stopped

    with pytest.raises(Stopped):
        train(run, data, launch("cpu"), train_too)


def test_settings_are_compared_with_what_another_command_has_begun_meanwhile(recorded, trained, tmp_path) -> None:
    run, other = _run(recorded, tmp_path / "run"), _run(recorded, tmp_path / "run", seed=1)
    shutil.copytree(trained.path, tmp_path / "run")
    before = _bytes_of(run)
    with pytest.raises(RunMismatch, match="holds another run: seed is 0 there and 1 here"):
        _train(other, recorded)
    _train(run, recorded, stop_at=1)  # was finished meanwhile
    assert run.result == trained.result
    assert _bytes_of(run) == before


@pytest.mark.slow
def test_conditions_are_those_that_another_command_has_begun_with(recorded, tmp_path) -> None:
    def asked(**request: int) -> Run:
        short = TrainingRequest(model="ed-cnn", labels="100%", settings=("epochs=0.1", "validations=1"), **request)
        return open_run(short, Dataset.open(recorded), tmp_path / "run", Workspace(tmp_path))

    run = asked()
    with pytest.raises(Stopped):
        _train(asked(threads=3), recorded, stop_at=1)
    _train(run, recorded)
    assert Run.open(run.path).conditions.threads == run.result["threads"] == 3


def test_no_training_is_taken_over_into_a_folder_that_another_command_has_begun(recorded, trained, tmp_path) -> None:
    shutil.copytree(trained.path, tmp_path / "one")
    run = _run(recorded, tmp_path / "two", labels="5-shot")
    other = _run(recorded, run.path, seed=1)
    run.path.mkdir()
    other.write()
    with pytest.raises(RunMismatch, match="seed is 1 there and 0 here"):
        finished_result(run)
    assert [path.name for path in run.path.iterdir()] == ["run.json"]
    assert Run.open(run.path).spec.seed == 1


def test_damaged_weights_are_not_deleted_while_another_command_trains_them_anew(recorded, trained, tmp_path) -> None:
    damaged = Run.open(shutil.copytree(trained.path, tmp_path / "run"))
    damaged.best.write_bytes(b"")
    with held(damaged.path), pytest.raises(FolderInUse):
        finished_result(damaged)
    assert damaged.last.exists()


@pytest.mark.slow
def test_a_training_that_was_killed_in_its_first_moments_goes_on(recorded, trained, tmp_path) -> None:
    request = TrainingRequest(model="dmotion", settings=SETTINGS)

    def work(moment: int) -> Run:
        run = begin(request, Dataset.open(recorded), Workspace(tmp_path), tmp_path / f"{moment}")
        with contextlib.suppress(Stopped):
            _train(run, recorded, stop_at=1)
        return run

    for moment in itertools.takewhile(lambda moment: moment < 4, each_kill(work)):
        again = work(moment)
        assert again.conditions is not None
        assert not list(again.path.glob("*.part"))


@pytest.mark.slow
def test_a_training_that_was_killed_while_it_took_another_over_goes_on(recorded, trained, tmp_path) -> None:
    request = TrainingRequest(model="dmotion", labels="5-shot", settings=SETTINGS)

    def work(name: object) -> Run:
        shutil.copytree(trained.path, tmp_path / f"{name}" / "one", dirs_exist_ok=True)
        run = begin(request, Dataset.open(recorded), Workspace(tmp_path), tmp_path / f"{name}" / "two")
        complete(run, Dataset.open(recorded), "cpu")
        return run

    whole, kills = work("whole"), 0
    for moment in each_kill(work):
        again = work(moment)
        assert again.manifest["trained_as"] == "one"
        assert again.result == whole.result
        assert _bytes_of(again) == _bytes_of(whole)
        kills += 1
    assert kills > 12


def test_a_training_begins_anew_if_its_source_was_deleted_while_it_was_taken_over(recorded, trained, tmp_path) -> None:
    shutil.copytree(trained.path, tmp_path / "one")
    with contextlib.suppress(Killed), killed_at(7):
        take_over(_run(recorded, tmp_path / "two", labels="5-shot"))
    run = _run(recorded, tmp_path / "two", labels="5-shot")
    assert run.manifest["trained_as"] == "one"
    assert run.metrics.exists()
    shutil.rmtree(tmp_path / "one")
    assert take_over(run) is None
    assert "trained_as" not in Run.open(run.path).manifest
    assert not run.metrics.exists()


def _bytes_of(run: Run) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in run.path.iterdir() if path.is_file()}


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
        _train(run, recorded)


def test_of_a_training_that_diverges_no_loss_of_a_triplet_is_kept(recorded, tmp_path, monkeypatch) -> None:
    nothing = np.full(4, np.nan, np.float32)
    monkeypatch.setattr(StepFigures, "per_triplet", property(lambda self: nothing))
    monkeypatch.setattr(StepFigures, "terms", property(lambda self: {"loss": math.nan}))
    asked = TrainingRequest(model="dmotion", settings=(*SETTINGS, "hard_share=0.5"))
    run = open_run(asked, Dataset.open(recorded), tmp_path / "run", Workspace(tmp_path))
    with pytest.raises(Stopped):  # the next validation says what is wrong
        _train(run, recorded, stop_at=2)
