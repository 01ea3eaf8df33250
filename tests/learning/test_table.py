"""The whole table: a row for every model and budget, and none that stops the others."""

from __future__ import annotations

import errno
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mortal_workers import Losing
from noise_world import noise_episode, noise_spec

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import RunError, StorageFull
from dmotion_bench.execution.local_executor import local_executor
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest
from dmotion_bench.learning.training import table
from dmotion_bench.learning.training.metrics_log import MetricsLog
from dmotion_bench.learning.training.table import Row, TableJob, budgets, rows, train_jobs, train_table
from dmotion_bench.registry import model_class, model_names
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.versions import deciding_versions
from dmotion_bench.workspace import Workspace

REQUEST = TrainingRequest(model="", preset=Preset.TINY, seed=3)


@pytest.fixture
def dataset(tmp_path) -> Dataset:
    path, spec = tmp_path / "data" / "noise-tiny", noise_spec(height=32, width=32)
    recipe = DatasetRecipe(environment="noise", episodes=12, frames=5, shard_episodes=12)
    with DatasetWriter.create_or_resume(path, recipe, spec) as writer:
        writer.write_shard(0, (noise_episode(number, 5, spec) for number in range(12)))
        writer.finish()
    return Dataset.open(path)


def _job(dataset: Dataset, workspace: Path, model: str = "ed-cnn", labels: str = "100%") -> TableJob:
    return TableJob(
        request=replace(REQUEST, settings=("epochs=1", "precision=float32")),
        rows=(Row(model=model, labels=labels),),
        dataset=dataset.where,
        workspace=workspace,
        device="cpu",
        threads=1,
        progress=None,
    )


def test_every_model_has_a_row_for_each_of_its_budgets(dataset) -> None:
    found = list(rows(dataset))
    assert {row.model for row in found} == {*model_names()}
    assert Row(model="dmotion", labels="one-shot") in found
    assert [row.labels for row in found if row.model == "ed-cnn"] == ["100%", "10%"]


def test_where_actions_are_not_known_what_needs_none_has_one_row(dataset, monkeypatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["cswm", "dmotoin", "lapo"])
    manifest = replace(dataset.manifest, spec=replace(dataset.spec, actions=None))
    unlabelled = Dataset(dataset.path, manifest, dataset.rows)
    assert list(rows(unlabelled)) == [Row(model="dmotoin", labels=""), Row(model="lapo", labels="none")]


def test_a_model_may_name_its_own_budgets() -> None:
    own = type("Own", (model_class("lapo"),), {"budgets": ("one-shot", "20-shot")})
    assert budgets(own, Discrete.numbered(2)) == ("one-shot", "20-shot")


def test_budgets_of_continuous_actions_are_numbers_of_transitions() -> None:
    moves = Continuous(names=("dx",), low=(-1.0,), high=(1.0,), units=("m",))
    assert budgets(model_class("dmotion"), moves) == ("64", "16", "256")
    assert budgets(model_class("ed-cnn"), moves) == ("100%", "10%")
    for name, kind in ((name, model_class(name)) for name in ("dmotion", "ed-cnn")):
        for budget in budgets(kind, moves):
            LabelRequest.for_model(name, kind.supervision, budget, moves)


def test_a_row_that_fails_does_not_stop_the_others(dataset, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["cswm", "ed-cnm", "lapo"])
    trained: list[str] = []

    def train(run: Run) -> None:
        if run.spec.labels == "10%":
            raise ZeroDivisionError("by hand")
        if run.spec.model == "lapo":
            if run.spec.labels == "20-shot":
                raise PermissionError(errno.EACCES, "Permission denied", "a/run.json")
            raise RunError("training diverged.")
        trained.append(run.path.name)

    outcomes = list(train_table(REQUEST, dataset, Workspace(tmp_path), train))
    assert [(outcome.row.model, outcome.row.labels, outcome.error) for outcome in outcomes] == [
        ("cswm", "100%", None),
        ("cswm", "10%", "ZeroDivisionError: by hand"),
        ("ed-cnm", "", outcomes[2].error),
        ("lapo", "one-shot", "training diverged."),
        ("lapo", "5-shot", "training diverged."),
        ("lapo", "20-shot", "may not write or read 'a/run.json': Permission denied."),
    ]
    assert "did you mean 'ed-cnn'?" in (outcomes[2].error or "")
    assert trained == ["cswm-noise-tiny-s3"]


@pytest.mark.slow
def test_a_row_that_fails_before_its_run_is_written_does_not_stop_the_others(dataset, tmp_path) -> None:
    few, enough = train_jobs([_job(dataset, tmp_path, "lapo", "200-shot"), _job(dataset, tmp_path)], local_executor(1))
    assert few.run is None
    assert "fewer than 200 demonstrations" in (few.error or "")
    assert enough.run is not None
    assert enough.error is None


def test_where_a_machine_does_not_see_the_data_its_rows_fail_and_name_it(dataset, tmp_path) -> None:
    elsewhere = replace(_job(dataset, tmp_path), dataset=tmp_path / "not-mounted" / "noise-tiny")
    unseen, seen = train_jobs([elsewhere, _job(dataset, tmp_path)], local_executor(1))
    assert f"the machine {socket.gethostname()!r} does not see the data set" in (unseen.error or "")
    assert "not-mounted" in (unseen.error or "")
    assert "under the same path" in (unseen.error or "")
    assert seen.error is None


def test_jobs_say_once_of_a_machine_that_it_has_other_packages_and_of_each_run_that_goes_on_with_them(
    dataset, tmp_path
) -> None:
    here = deciding_versions()
    first, second = (
        replace(_job(dataset, tmp_path, labels=labels), versions=here | {"torch": "1.0"}) for labels in ("100%", "10%")
    )
    one, other = train_jobs([first, second], local_executor(1))
    machine = f"the machine {socket.gethostname()!r} trains with torch {here['torch']}, and the one where the command"
    assert [told.startswith(machine) for told in one.warnings] == [True]
    assert other.warnings == ()
    assert one.run is not None
    one.run.manifest |= {"result": None, "versions": one.run.manifest["versions"] | {"torch": "1.0"}}
    one.run.write()
    (again,) = train_jobs([replace(first, versions=here)], local_executor(1))
    assert "goes on with another version than it began with (torch 1.0, " in again.warnings[0]
    assert str(one.run.path) in again.warnings[0]


@pytest.mark.slow
def test_of_a_lost_job_the_rows_that_are_not_trained_fail(dataset, tmp_path) -> None:
    trained, both, other = (
        replace(_job(dataset, tmp_path), rows=tuple(Row(model=model, labels=labels) for model, labels in own))
        for own in ([("ed-cnn", "100%")], [("ed-cnn", "100%"), ("ed-cnn", "10%")], [("cswm", "100%")])
    )
    list(train_jobs([trained], local_executor(1)))
    outcomes = list(train_jobs([both, other], Losing()))
    assert [(one.row.model, one.row.labels, one.error) for one in outcomes] == [
        ("cswm", "100%", None),
        ("ed-cnn", "100%", None),
        ("ed-cnn", "10%", "a worker was killed."),
    ]
    assert outcomes[1].run is not None
    assert outcomes[1].run.result is not None


NO_FULL_DISK = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no file of this system is always full")


@pytest.mark.parametrize("when", ["at once", pytest.param("later", marks=NO_FULL_DISK)])
def test_a_full_disk_stops_the_table(dataset, tmp_path, monkeypatch, when) -> None:
    opened = Path.open

    def full(path: Path, mode: str = "r", *given: Any, **named: Any) -> Any:
        return opened(Path("/dev/full") if mode == "a" else path, mode, *given, **named)

    def train(run: Run) -> None:
        if when == "at once":
            raise StorageFull("no space left.")
        with MetricsLog.resumed(run.metrics, 0) as log:  # a row is appended, and no file appears as a whole
            log.write(step=1, seconds=1.0, triplets_per_s=1.0, learning_rate=1.0, values={})

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(StorageFull, match=r"^no space left"):
        list(train_table(REQUEST, dataset, Workspace(tmp_path), train))
