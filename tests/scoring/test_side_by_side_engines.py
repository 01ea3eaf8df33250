"""Prediction and control scored by the real engines, workers killed in the middle: the reports of scoring in turn."""

from __future__ import annotations

import importlib.util
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pytest
from dmbench_command import ended_by_ctrl_c, interrupted_once, start_dmbench
from known_model import result_of
from mortal_workers import Deadly, called_apart, engine

from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.local_executor import local_executor
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.kept_control import shares_of
from dmotion_bench.scoring.report import read_report
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.side_by_side import ScoreJob, control_shares, score_side_by_side
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

Job = TypeVar("Job")
Result = TypeVar("Result")
MODELS = ("ed-cnn", "cswm")
FEW = ("samples=3", "horizon=2", "iterations=1", "elites=2")
SETTINGS = ScoreSettings(
    resamples=100, control=ControlScoring(tasks=3, steps=3, group=2, objective="centres", planner_set=FEW)
)


@dataclass(frozen=True)
class DeadlyEachTime:
    """An executor that kills a worker at the second job of every call: among the groups of tasks, and the runs."""

    executor: Executor
    folder: Path

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        mark = self.folder / f"died-{len(list(self.folder.glob('died-*')))}"
        yield from Deadly(self.executor, mark).map_unordered(function, jobs)


def jobs_in(workspace: Path) -> list[ScoreJob]:
    """A job for each run."""
    return [
        ScoreJob(
            run=path,
            metrics=("prediction", "control"),
            settings=SETTINGS,
            renew=False,
            data=None,
            batch_size=64,
            device="cpu",
        )
        for path in sorted((workspace / "runs").iterdir())
    ]


def reports_in(workspace: Path) -> dict[str, tuple[object, bytes]]:
    """What each report says, and the bytes of its samples."""
    found: dict[str, tuple[object, bytes]] = {}
    for path in sorted((workspace / "runs").iterdir()):
        report = read_report(path / "report")
        assert report is not None
        samples = (path / "report" / "samples.parquet").read_bytes()
        found[path.name] = ((report.figures, report.reference, report.settings), samples)
        assert not shares_of(path / "report" / "control.json")
    return found


def scored_by(name: str, workspace: Path) -> None:
    """Score all runs by an executor whose workers are killed, one among the groups of tasks and one among the runs."""
    jobs = jobs_in(workspace)
    assert [[share.tasks for share in control_shares(job)] for job in jobs] == [[(0, 1), (2,)]] * len(MODELS)
    executor = engine(name, workspace / "slurm")
    if name == "ray":  # for both, as each would start a Ray of its own
        import ray

        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    outcomes = list(score_side_by_side(jobs, DeadlyEachTime(executor, workspace)))
    assert [outcome.error for outcome in outcomes] == [None] * len(MODELS)
    assert len(list(workspace.glob("died-*"))) == 2


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with a Grid World that has tasks, and runs whose weights are those of the start."""
    root = tmp_path_factory.mktemp("trained")
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=20, frames=32, tasks=3
    )
    record_dataset(root / "data" / "grid", recipe)
    dataset = Dataset.open(root / "data" / "grid")
    with using_threads(1):
        for model in MODELS:
            request = TrainingRequest(model=model, labels="100%", preset=Preset.TINY)
            run = open_run(request, dataset, None, Workspace(root))
            weights = run.spec.build().state_dict()
            checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
            run.finish(result_of(weights) | {"threads": 1})
    return root


@pytest.fixture(scope="module")
def in_turn(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[object, bytes]]:
    workspace = copied(trained, tmp_path_factory.mktemp("in-turn"))
    assert [one.error for one in score_side_by_side(jobs_in(workspace), local_executor(1))] == [None] * len(MODELS)
    return reports_in(workspace)


def copied(trained: Path, workspace: Path) -> Path:
    """The runs in another workspace, which reads the same data set."""
    shutil.copytree(trained / "runs", workspace / "runs")
    return workspace


@pytest.mark.slow
def test_a_killed_worker_changes_no_figure(
    trained: Path,
    in_turn: dict[str, tuple[object, bytes]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    scored_by("local", copied(trained, tmp_path))
    assert reports_in(tmp_path) == in_turn
    assert len(in_turn) == len(MODELS)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_a_killed_worker_of_ray_changes_no_figure(
    trained: Path, in_turn: dict[str, tuple[object, bytes]], tmp_path: Path
) -> None:
    called_apart("scoring.test_side_by_side_engines", "scored_by", copied(trained, tmp_path))
    assert reports_in(tmp_path) == in_turn


@pytest.mark.slow
def test_ctrl_c_ends_all_jobs_and_says_how_to_go_on(trained: Path, tmp_path: Path) -> None:
    copied(trained, tmp_path)
    run = next((tmp_path / "runs").iterdir()).name
    words = ("score", run, "--metrics", "control", "--tasks", "3", "--workers", "2")
    process = start_dmbench(words, tmp_path)

    def shares() -> list[Path]:
        return list(tmp_path.glob("runs/*/report/control-*.json"))

    workers = interrupted_once(process, lambda: bool(shares()), signal.SIGINT)
    ended_by_ctrl_c(process, workers, tmp_path)
    assert shares()  # from which the same command goes on
