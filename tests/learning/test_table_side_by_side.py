"""Models trained by the real engines, a worker killed in the middle: the weights of a training in turn."""

from __future__ import annotations

import importlib.util
import json
import shutil
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from mortal_workers import Deadly, called_apart, engine
from walking_square import record_walks

from dmotion_bench.learning.runs.start import TrainingRequest
from dmotion_bench.learning.training.table import Row, TableJob, train_jobs, train_rows, train_side_by_side
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

ROWS = (("lapo", ("one-shot", "8")), ("ed-cnn", ("100%",)), ("cswm", ("100%",)))
SETTINGS = ("epochs=1", "precision=float32", "batch_size=8")


def jobs_in(data: Path, workspace: Path) -> list[TableJob]:
    """A job for each model."""
    request = TrainingRequest(model="", preset=Preset.TINY, settings=SETTINGS)
    return [
        TableJob(
            request=request,
            rows=tuple(Row(model=model, labels=labels) for labels in budgets),
            dataset=data,
            workspace=workspace,
            device="cpu",
            threads=1,
            progress=None,
        )
        for model, budgets in ROWS
    ]


def weights_in(workspace: Path) -> dict[str, str]:
    """The hash of the weights of each run."""
    manifests = sorted(workspace.glob("runs/*/run.json"))
    return {path.parent.name: json.loads(path.read_bytes())["result"]["weights"] for path in manifests}


def trained_by(name: str, data: Path, workspace: Path) -> None:
    """Train all jobs by an executor whose first worker at the second job is killed."""
    doomed = Deadly(engine(name, workspace / "slurm"), workspace / "died")
    outcomes = list(train_jobs(jobs_in(data, workspace), doomed))
    assert [outcome.error for outcome in outcomes] == [None] * 4
    assert (workspace / "died").exists()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-tiny")


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace in which all was trained in turn."""
    workspace = tmp_path_factory.mktemp("in-turn")
    for job in jobs_in(data, workspace):
        assert [one.error for one in train_rows(job)] == [None] * len(job.rows)
    return workspace


@pytest.fixture(scope="module")
def in_turn(trained: Path) -> dict[str, str]:
    return weights_in(trained)


class Counting:
    """An executor that does its jobs in this process, and remembers them."""

    def __init__(self) -> None:
        self.jobs: list[TableJob] = []

    def map_unordered(self, function: Callable[[TableJob], Any], items: Iterable[TableJob]) -> Generator[Any]:
        for item in items:
            self.jobs.append(item)
            yield function(item)


def test_what_is_trained_needs_no_job(data: Path, trained: Path, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "copied")
    shutil.copytree(trained, workspace.root)
    before = weights_in(workspace.root)
    request = TrainingRequest(model="", preset=Preset.TINY, settings=SETTINGS)
    chosen = [Row(model=model, labels=labels) for model, budgets in ROWS for labels in budgets]

    def again(rows: Sequence[Row]) -> list[str]:
        """The models of the jobs that were started."""
        executor = Counting()
        outcomes = list(train_side_by_side(request, rows, Dataset.open(data), workspace, executor))
        assert {one.row for one in outcomes} == set(rows)
        assert all(one.error is None and one.run is not None and one.run.result for one in outcomes)
        return [job.rows[0].model for job in executor.jobs]

    assert again(chosen) == []
    (damaged,) = workspace.root.glob("runs/cswm-*")
    (damaged / "best.safetensors").write_bytes(b"damaged")
    assert again(chosen) == ["cswm"]
    assert weights_in(workspace.root) == before
    assert again([*chosen[:2], Row(model="lapo", labels="4"), *chosen[2:]]) == [
        "lapo"
    ]  # the others of its job wait for it


def test_the_threads_of_whoever_calls_are_as_many_as_before(tmp_path: Path) -> None:
    """A single worker is the present process; what it trains next may record its number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        (found, *_) = train_rows(jobs_in(tmp_path / "away", tmp_path)[0])
        assert found.error is not None
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_a_killed_worker_costs_one_job(
    data: Path, in_turn: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    trained_by("local", data, tmp_path)
    assert weights_in(tmp_path) == in_turn
    assert len(in_turn) == 4


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_a_killed_worker_of_ray_costs_one_job(data: Path, in_turn: dict[str, str], tmp_path: Path) -> None:
    called_apart("learning.test_table_side_by_side", "trained_by", data, tmp_path)
    assert weights_in(tmp_path) == in_turn
