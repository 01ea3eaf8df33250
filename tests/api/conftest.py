"""A workspace with a data set and a run, as the examples of the docstrings name them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import dmotion_bench as dm

EPOCHS = 0.5  # two steps


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``data/grid_world-tiny`` with two control tasks, and ``runs/tiny``; not to be changed."""
    root = tmp_path_factory.mktemp("made")
    dm.record("grid_world", "tiny", tasks=2, workspace=str(root))
    dm.train("dmotion", workspace=str(root), out=str(root / "runs" / "tiny"), settings={"epochs": EPOCHS}, threads=1)
    return root


@pytest.fixture
def workspace(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it that is the working folder; what a test registers is forgotten afterwards."""
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    root = tmp_path / "workspace"
    shutil.copytree(made, root)
    monkeypatch.chdir(root)
    monkeypatch.delenv("DMBENCH_WORKSPACE", raising=False)
    return root
