"""A training's folder: its name, who may write into it, and what a kill leaves of its beginning."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import shutil

import pytest
from killed_writes import Killed, each_kill, killed_at
from learning.short_training import SETTINGS, Stopped, short_run, train_short
from made_up_import import write_import

from dmotion_bench.api.training import begin, complete
from dmotion_bench.errors import (
    FolderInUse,
    LabelsNotAvailable,
    RunCorrupt,
    RunMismatch,
    RunMissing,
    UnknownName,
    UsageError,
)
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, default_path, open_run, resolve, training_data
from dmotion_bench.learning.training.beginning import finished_result
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.shared_pretraining import take_over
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.learning.training.table import Row, TableJob, train_rows
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import held
from dmotion_bench.workspace import Workspace


@pytest.mark.parametrize(
    ("model", "labels", "name"),
    [
        ("dmotion", None, "dmotion-walk-test-small-s0"),
        ("dmotion", "100%", "dmotion-walk-test-small-100pct-s0"),
        ("idm-ed-cnn", "100%", "idm-ed-cnn-walk-test-small-100pct-s0"),
        ("ed-cnn", "100%", "ed-cnn-walk-test-small-s0"),
        ("ed-cnn", "64", "ed-cnn-walk-test-small-64-s0"),
        ("ed-cnn", "1000000", "ed-cnn-walk-test-small-s0"),  # more than there are is all
        ("dmotion", "1000000", "dmotion-walk-test-small-100pct-s0"),
    ],
)
def test_each_budget_has_a_folder_of_its_own(recorded, tmp_path, model, labels, name) -> None:
    request = TrainingRequest(model=model, labels=labels)
    spec = resolve(request, Dataset.open(recorded))
    assert default_path(request, spec, Workspace(tmp_path)) == tmp_path / "runs" / name


def test_an_empty_architecture_is_none(recorded) -> None:
    with pytest.raises(UnknownName, match="no architecture of dmotion named ''; known: compact, paper"):
        resolve(TrainingRequest(model="dmotion", arch=""), Dataset.open(recorded))


def test_a_budget_that_is_larger_than_the_data_set_is_refused_with_what_there_is(recorded, tmp_path) -> None:
    dataset = Dataset.open(recorded)
    there = int((dataset.lengths - 1).sum())
    asked = TrainingRequest(model="ed-cnn", labels=str(there))
    assert begin(asked, dataset, Workspace(tmp_path), None).spec.labels == str(there)
    with pytest.raises(UsageError, match=f"'--labels {there + 1}' asks for more .* has, {there}; .* '--labels all'"):
        begin(dataclasses.replace(asked, labels=str(there + 1)), dataset, Workspace(tmp_path), None)


@pytest.mark.parametrize("labels", ["4", "one-shot", "all"])
def test_labels_of_unknown_actions_are_refused_where_a_training_could_be_taken_over(recorded, tmp_path, labels) -> None:
    video = write_import(tmp_path / "data" / "video", Dataset.open(recorded), actions=())
    request = TrainingRequest(model="dmotion", settings=SETTINGS)
    run = begin(request, video, Workspace(tmp_path), None)
    train_short(run, video.path)
    with pytest.raises(LabelsNotAvailable, match="nothing to demonstrate"):
        begin(dataclasses.replace(request, labels=labels), video, Workspace(tmp_path), None)
    assert [*(tmp_path / "runs").iterdir()] == [run.path]


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
def test_the_folder_of_another_request_is_refused_and_says_why(recorded, trained) -> None:
    with pytest.raises(RunMismatch, match="seed is 0 there and 5 here"):
        short_run(recorded, trained.path, seed=5)
    with pytest.raises(RunMismatch, match=r"epochs: 0.4.* there and .*epochs: 0.7"):
        open_run(
            TrainingRequest(model="dmotion", settings=(*SETTINGS[:1], "epochs=0.7", *SETTINGS[2:])),
            Dataset.open(recorded),
            trained.path,
            Workspace(trained.path),
        )


def test_a_finished_run_is_not_trained_again(recorded, trained) -> None:
    before = trained.best.read_bytes()
    train_short(short_run(recorded, trained.path), recorded, stop_at=1)
    assert trained.best.read_bytes() == before


@pytest.mark.slow
def test_a_run_is_trained_by_one_at_a_time(recorded, tmp_path) -> None:
    run = short_run(recorded, tmp_path / "run")
    data = training_data(run, Dataset.open(recorded))

    def train_too(report: StepReport) -> None:
        with pytest.raises(FolderInUse, match="another dmbench is writing into"):
            train_short(short_run(recorded, run.path), recorded)
        raise Stopped

    with pytest.raises(Stopped):
        train(run, data, launch("cpu"), train_too)


def test_settings_are_compared_with_what_another_command_has_begun_meanwhile(recorded, trained, tmp_path) -> None:
    run, other = short_run(recorded, tmp_path / "run"), short_run(recorded, tmp_path / "run", seed=1)
    shutil.copytree(trained.path, tmp_path / "run")
    before = _bytes_of(run)
    with pytest.raises(RunMismatch, match="holds another run: seed is 0 there and 1 here"):
        train_short(other, recorded)
    train_short(run, recorded, stop_at=1)  # was finished meanwhile
    assert run.result == trained.result
    assert _bytes_of(run) == before


@pytest.mark.slow
def test_conditions_are_those_that_another_command_has_begun_with(recorded, tmp_path) -> None:
    def asked(**request: int) -> Run:
        short = TrainingRequest(model="ed-cnn", labels="100%", settings=("epochs=0.1", "validations=1"), **request)
        return open_run(short, Dataset.open(recorded), tmp_path / "run", Workspace(tmp_path))

    run = asked()
    with pytest.raises(Stopped):
        train_short(asked(threads=3), recorded, stop_at=1)
    train_short(run, recorded)
    assert Run.open(run.path).conditions.threads == run.result["threads"] == 3


def test_no_training_is_taken_over_into_a_folder_that_another_command_has_begun(recorded, trained, tmp_path) -> None:
    shutil.copytree(trained.path, tmp_path / "one")
    run = short_run(recorded, tmp_path / "two", labels="5-shot")
    other = short_run(recorded, run.path, seed=1)
    run.path.mkdir()
    other.write()
    with pytest.raises(RunMismatch, match="seed is 1 there and 0 here"):
        finished_result(run)
    assert [path.name for path in run.path.iterdir()] == ["run.json"]
    assert Run.open(run.path).spec.seed == 1


def test_no_training_is_taken_over_for_labels_that_are_not_there(recorded, trained, tmp_path) -> None:
    dataset = Dataset.open(recorded)
    shutil.copytree(trained.path, tmp_path / "one")
    request = TrainingRequest(model="dmotion", labels="900-shot", settings=SETTINGS)
    run = begin(request, dataset, Workspace(tmp_path), tmp_path / "two")
    with pytest.raises(LabelsNotAvailable, match="fewer than 900 demonstrations"):
        complete(run, dataset, "cpu")
    job = TableJob(
        request=request,
        rows=(Row(model="dmotion", labels="900-shot"),),
        dataset=recorded,
        workspace=tmp_path,
        device="cpu",
        threads=1,
        progress=None,
    )
    usual = default_path(request, resolve(request, dataset), Workspace(tmp_path))
    shutil.copytree(trained.path, usual.parent / "one")
    (row,) = train_rows(job)
    assert "fewer than 900 demonstrations" in str(row.error)
    assert not run.path.exists()
    assert not usual.exists()


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
            train_short(run, recorded, stop_at=1)
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
        take_over(short_run(recorded, tmp_path / "two", labels="5-shot"))
    run = short_run(recorded, tmp_path / "two", labels="5-shot")
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
