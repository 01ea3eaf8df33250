"""A workspace with three scored runs of models that learn nothing.

They are of a Grid World of 50 short episodes, of which 5 are test episodes: as many as an interval takes.
"""

from __future__ import annotations

import copy
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_model import Known, write_run

from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.workspace import Workspace
from leaderboard.board import Board
from leaderboard.build import entry_of_run
from leaderboard.entry import Entry
from leaderboard.row import Row
from recorders.grid_things import FACTS
from recorders.grid_world import GridWorld

SETTINGS = ScoreSettings(horizon=3, resamples=200)
EPISODES = list(range(40))
FRAMES = 25
TASK_EPISODES = list(range(25))
"""Of the tasks that ``controlled`` makes entries of; one each."""


@pytest.fixture(autouse=True)
def _model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)


@pytest.fixture(scope="session")
def scored_workspace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workspace]:
    """Read only; ``workspace`` is a copy."""
    workspace = Workspace(tmp_path_factory.mktemp("workspace"))
    recipe = DatasetRecipe(environment="grid_world", parameters={"version": 2}, seed=3, episodes=50, frames=12)
    with DatasetWriter.create_or_resume(workspace.data / "grid_world-tiny", recipe, FACTS) as writer:
        for index in writer.missing:
            writer.write_shard(index, record_episodes(GridWorld, recipe, writer.episodes_of(index)))
        writer.finish()
    dataset = Dataset.open(workspace.data / "grid_world-tiny")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)
        shared = SharedSamples()
        for name, offset, changes in (
            ("dmotion-grid_world-tiny-s0", 0.0, {}),
            ("dmotion-grid_world-tiny-s1", 0.02, {"seed": 1}),
            ("cswm-grid_world-tiny-10pct-s0", 0.5, {"model": "cswm", "labels": "10%"}),
        ):
            run = write_run(workspace.runs / name, dataset, offset=offset, **changes)
            score_run(run.path, settings=SETTINGS, how=Execution(), shared=shared)
    return workspace


@pytest.fixture
def workspace(scored_workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A copy to spoil."""
    copied = Workspace(tmp_path / "workspace")
    shutil.copytree(scored_workspace.root, copied.root)
    for path in copied.all_runs():
        manifest = json.loads((path / "run.json").read_text())
        manifest["dataset_path"] = str(copied.data / "grid_world-tiny")
        (path / "run.json").write_text(json.dumps(manifest))
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(copied.root))
    return copied


@pytest.fixture(scope="session")
def sound(scored_workspace: Workspace) -> Entry:
    """The entry of the first run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)
        return entry_of_run(scored_workspace.runs / "dmotion-grid_world-tiny-s0")


@pytest.fixture(scope="session")
def shared() -> SharedSamples:
    """What checks compute alike, once for all tests."""
    return SharedSamples()


@pytest.fixture
def changed(sound: Entry) -> Callable[..., Entry]:
    """The sound entry with some of its content replaced: ``changed(mse={...}, seed=3)``."""

    def change(**content: Any) -> Entry:
        return Entry(copy.deepcopy(dict(sound.content)) | content)

    return change


def controlled(entry: Entry, model: str, distance: float) -> Entry:
    """An entry with made-up figures of control: 50 steps that lead to a distance."""

    def figure(mean: float) -> dict[str, Any]:
        return {"mean": mean, "std": 0.1, "low": mean - 0.1, "high": mean + 0.1, "n": 7}

    def figures(end: float) -> dict[str, Any]:
        steps = {f"control_distance[{step}]": figure(1 + (end - 1) * step / 50) for step in range(1, 51)}
        return steps | {"control_success": figure(0.5), "control_lost": figure(0.0)}

    content = copy.deepcopy(dict(entry.content)) | {"run": f"{model}-s0", "model": model}
    content["figures"] |= figures(distance)
    content["reference"] |= {"idle": figures(1.0), "oracle": figures(0.1)}
    return Entry(content)


def weights_of(model: str, seed: int) -> str:
    """The hash of a made-up training's weights."""
    return hashlib.sha256(f"{model} {seed}".encode()).hexdigest()


def figure_over(mean: float, n: int) -> dict[str, Any]:
    """A figure of control over some tasks."""
    return {"mean": mean, "std": 0.1, "low": mean - 0.05, "high": mean + 0.05, "n": n}


@pytest.fixture(name="controlled")
def _controlled_by_column(sound: Entry) -> Callable[..., Entry]:
    """Makes an entry of one training's control by a column."""

    def make(
        model: str,
        left: np.ndarray,
        *,
        column: str | None = "generic",
        seed: int = 0,
        labels: Any = "one-shot",
        **more: Any,
    ) -> Entry:
        content = copy.deepcopy(dict(sound.content))
        n = len(left)
        dataset = content["dataset"] | {"name": "grid-test", "trained_on": {"name": "grid", "fingerprint": "0" * 64}}
        idle = {
            "control_distance[2]": figure_over(1.0, n),
            "control_success": figure_over(0.0, n),
            "control_lost": figure_over(0.0, n),
        }
        oracle = idle | {"control_distance[2]": figure_over(0.1 if column == "paper" else 0.05, n)}
        content |= {
            "protocol": "dmbench-1" if column is None else "dmbench-2",
            "model": model,
            "seed": seed,
            "run": f"{model}-grid-tiny-s{seed}",
            "weights": weights_of(model, seed),
            "labels": labels if isinstance(labels, dict) else {"asked": labels, "given": {}, "total": 4},
            "dataset": dataset,
            "settings": content["settings"]
            | {"metrics": ["control"], "control_version": 1}
            | ({} if column is None else {"control_column": column}),
            "figures": {
                "control_distance[1]": figure_over(0.9, n),
                "control_distance[2]": figure_over(float(left.mean()), n),
                "control_success": figure_over(float((left <= 0.2).mean()), n),
                "control_lost": figure_over(0.1, n),
            },
            "by_episode": {"control_distance[2]": {"episode": TASK_EPISODES, "n": [1] * n, "sum": left.tolist()}},
            "reference": {"idle": idle, "oracle": oracle},
            "remarks": {},
            "pictures": [],
        }
        return Entry(content | more)

    return make


@pytest.fixture
def result(sound: Entry) -> Callable[..., Entry]:
    """Makes an entry whose error in each episode is given."""

    def make(model: str, errors: np.ndarray, *, seed: int = 0, labels: Any = "one-shot", **content: Any) -> Entry:
        made = copy.deepcopy(dict(sound.content))
        figure = {"mean": float(errors.mean()), "std": 1.0, "low": None, "high": None, "n": FRAMES * len(EPISODES)}
        sums = {"episode": EPISODES, "n": [FRAMES] * len(EPISODES), "sum": (errors * FRAMES).tolist()}
        told = labels if isinstance(labels, dict) else {"asked": labels, "given": {}, "total": 4}
        made |= {"model": model, "seed": seed, "run": f"{model}-{told['asked']}-s{seed}"}
        made |= {"weights": weights_of(model, seed)}
        made |= {"figures": made["figures"] | {"mse": figure}, "by_episode": {"mse": sums}}
        made["labels"] = told
        return Entry(made | content)

    return make


@pytest.fixture
def budgeted(sound: Entry) -> Callable[..., Entry]:
    """Makes an entry: of a model, under a budget, with so many labels and such an error in every episode.

    Further figures are given by their names: they and what copying has of them.
    """

    def entry(
        model: str, labels: str, total: int, error: float, *, seed: int = 0, copying: float = 8.0, **figures: float
    ) -> Entry:
        def figure(mean: float) -> dict[str, Any]:
            return {"mean": mean, "std": 1.0, "low": mean, "high": mean, "n": FRAMES * len(EPISODES)}

        made = copy.deepcopy(dict(sound.content))
        sums = {"episode": EPISODES, "n": [FRAMES] * len(EPISODES), "sum": [error * FRAMES] * len(EPISODES)}
        made["figures"] |= {name: figure(mean) for name, mean in {"mse": error, **figures}.items()}
        made["reference"]["copy_last"] |= {name: figure(copying) for name in figures}
        made |= {"model": model, "seed": seed, "run": f"{model}-{labels}-s{seed}", "by_episode": {"mse": sums}}
        made |= {"weights": weights_of(model, seed)}
        return Entry(made | {"labels": {"asked": labels, "given": {}, "total": total}})

    return entry


def row_named(board: Board, name: str) -> Row:
    (row,) = (row for row in board.rows if row.name == name and row.kind == "measured")
    return row
