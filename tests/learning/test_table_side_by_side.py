"""Models trained by the real engines, a worker killed in the middle: the weights of a training in turn."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
import torch
from mortal_workers import Deadly, called_apart, engine
from walking_square import record_walks

from dmotion_bench.learning.runs.start import TrainingRequest
from dmotion_bench.learning.training.table import Row, TableJob, train_jobs, train_rows
from dmotion_bench.specs import Preset

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
def in_turn(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    workspace = tmp_path_factory.mktemp("in-turn")
    for job in jobs_in(data, workspace):
        assert [one.error for one in train_rows(job)] == [None] * len(job.rows)
    return weights_in(workspace)


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
