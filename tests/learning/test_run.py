"""A run finds its data set from any folder, and after its workspace has moved."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dmotion_bench.learning.run import Run, RunSpec


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    (tmp_path / "work" / "data" / "grid").mkdir(parents=True)
    (tmp_path / "work" / "data" / "grid" / "dataset.json").write_text("{}")
    return tmp_path / "work"


def run_of(workspace: Path, dataset_path: str) -> Run:
    """A run whose manifest names this path."""
    spec = RunSpec(
        model="dmotion",
        arch="compact",
        config={},
        training={},
        preset="tiny",
        labels="none",
        seed=0,
        dataset="grid",
        fingerprint="f",
        height=8,
        width=8,
        actions=4,
    )
    (workspace / "runs").mkdir(exist_ok=True)
    shutil.rmtree(workspace / "runs" / "one", ignore_errors=True)
    made = Run.create_or_open(workspace / "runs" / "one", spec, dataset_path=Path(dataset_path), versions={})
    made.write()
    return Run.open(made.path)


def test_from_another_folder(workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_of(workspace, "data/grid").dataset_path == workspace / "data" / "grid"
    other = tmp_path / "data" / "grid"  # of the same name, where the command is typed
    other.mkdir(parents=True)
    (other / "dataset.json").write_text("{}")
    assert run_of(workspace, "data/grid").dataset_path == workspace / "data" / "grid"
    assert run_of(workspace, str(other)).dataset_path == other


def test_in_a_workspace_that_has_moved(workspace: Path, tmp_path: Path) -> None:
    run_of(workspace, str(workspace / "data" / "grid"))
    moved = workspace.rename(tmp_path / "moved")
    assert Run.open(moved / "runs" / "one").dataset_path == moved / "data" / "grid"


def test_what_is_gone_is_named_as_it_was_given(workspace: Path) -> None:
    assert run_of(workspace, "data/other").dataset_path == Path("data/other")
