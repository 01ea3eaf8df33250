"""A data set of squares on disk, and a run on it whose model has learned nothing."""

from __future__ import annotations

import faulthandler
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from known_model import result_of
from pushed_squares import MOVED, write_squares

from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing import viewer
from dmotion_bench.workspace import Workspace

METRICS = [
    {"step": 2, "learning_rate": 0.003, "triplets_per_s": 40.0, "loss": 1.5, "prediction": 0.5},
    {"step": 4, "learning_rate": 0.001, "triplets_per_s": 50.0, "loss": 0.75, "prediction": 0.25},
    {"step": 4, "learning_rate": 0.001, "triplets_per_s": 50.0, "validation_loss": 0.8},
]


HANGS = 420
"""Seconds after which a test that waits inside Rerun is ended, and its process with it."""


@pytest.fixture(autouse=True)
def _never_hangs() -> Iterator[None]:
    faulthandler.dump_traceback_later(HANGS, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="session", autouse=True)
def _own_ports() -> Iterator[None]:
    """Tests that run beside these may use the usual ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewer, "WEB_PORT", 0)
        patch.setattr(viewer, "LIVE_PORT", 0)
        yield


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return Workspace(tmp_path_factory.mktemp("workspace"))


@pytest.fixture(scope="session")
def dataset(workspace: Workspace) -> Dataset:
    return write_squares(workspace.data / "squares-tiny")


@pytest.fixture(scope="session")
def run(workspace: Workspace, dataset: Dataset) -> Run:
    return _untrained(workspace, dataset, seed=0)


@pytest.fixture(scope="session")
def other_run(workspace: Workspace, dataset: Dataset) -> Run:
    return _untrained(workspace, dataset, seed=1)


@pytest.fixture(scope="session")
def moved(workspace: Workspace) -> Dataset:
    """Squares with continuous actions."""
    return write_squares(workspace.data / "squares-moved", spec=MOVED)


@pytest.fixture(scope="session")
def moved_runs(workspace: Workspace, moved: Dataset) -> list[Run]:
    return [_untrained(workspace, moved, seed, labels="8") for seed in (0, 1)]


def _untrained(workspace: Workspace, dataset: Dataset, seed: int, labels: str | None = None) -> Run:
    request = TrainingRequest(model="dmotion", preset=Preset.TINY, seed=seed, labels=labels)
    run = open_run(request, dataset, None, workspace)
    torch.manual_seed(seed)
    weights = run.spec.build().state_dict()
    checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
    run.metrics.write_text("".join(f"{json.dumps(row)}\n" for row in METRICS) + '{"step": 5, "lo')
    run.finish(result_of(weights))
    return run


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    return tmp_path / "scene.rrd"
