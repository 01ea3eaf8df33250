"""Scoring as jobs: control in shares is control in one piece, whatever happens to a job on the way."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from known_model import Known, write_run
from mortal_workers import Losing

from dmotion_bench.api.side_by_side import Hands, score_at_once
from dmotion_bench.execution.job_progress import read_progress
from dmotion_bench.execution.local_executor import local_executor
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring import side_by_side
from dmotion_bench.scoring.control import ControlScoring, score_control
from dmotion_bench.scoring.kept_control import shares_of
from dmotion_bench.scoring.report import read_report
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.side_by_side import ScoreJob, control_shares, score_job, score_side_by_side
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import in_turn
from dmotion_bench.workspace import Workspace

FEW = ("samples=3", "horizon=2", "iterations=1", "elites=2")
SCORING = ControlScoring(tasks=5, steps=4, group=2, planner_set=FEW)
SETTINGS = ScoreSettings(horizon=3, resamples=100, control=SCORING)
MakeJob = Callable[..., ScoreJob]


@pytest.fixture(scope="module")
def tasks(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A Grid World with tasks; read only but for its cache."""
    path = tmp_path_factory.mktemp("data") / "grid"
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=40, frames=32, tasks=6
    )
    record_dataset(path, recipe)
    return Dataset.open(path)


@pytest.fixture
def job(tasks: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MakeJob:
    """Makes the job of a run that does not exist yet."""
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)

    def make(name: str, **changes: Any) -> ScoreJob:
        path = write_run(tmp_path / name, tasks).path if not (tmp_path / name).exists() else tmp_path / name
        asked: dict[str, Any] = {"metrics": ("control",), "settings": SETTINGS, "renew": False, "data": None}
        return ScoreJob(run=path, batch_size=64, device="cpu", **(asked | changes))

    return make


def _told(run: Path) -> tuple[Any, bytes]:
    report = read_report(run / "report")
    assert report is not None
    return (report.figures, report.reference), (run / "report" / "samples.parquet").read_bytes()


def test_shares_are_whole_groups(job: MakeJob) -> None:
    assert [share.tasks for share in control_shares(job("a"))] == [(0, 1), (2, 3), (4,)]
    assert not list(control_shares(job("a", metrics=("prediction",))))
    assert not list(control_shares(job("a", metrics=None)))


@pytest.mark.slow
def test_control_in_shares_is_control_in_one_piece(job: MakeJob, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = job("whole")
    score_run(whole.run, metrics=("control",), settings=SETTINGS)
    shared = job("shared")
    for share in reversed(list(control_shares(shared))):
        assert score_job(share).error is None
    assert len(shares_of(shared.run / "report" / "control.json")) == 3
    with monkeypatch.context() as patch:  # nothing is left to plan
        patch.setattr(Known, "predict", None)
        assert score_job(shared).error is None

    assert _told(shared.run) == _told(whole.run)
    assert not shares_of(shared.run / "report" / "control.json")
    assert not list(control_shares(shared))  # it is scored


def test_shares_go_on_where_control_in_one_piece_stopped(
    job: MakeJob, tasks: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = job("begun")
    run, journal = Run.open(begun.run), begun.run / "report" / "control.json"
    journal.parent.mkdir()
    score_control(run.model, tasks, replace(SCORING, tasks=2), checkpoint=journal)
    first, second, _ = control_shares(begun)

    monkeypatch.setattr(Known, "predict", None)

    assert score_job(first).error is None  # nothing was left to plan
    assert score_job(second).error is not None


def test_a_share_that_another_command_works_on_is_waited_for(job: MakeJob) -> None:
    share = next(iter(control_shares(job("a"))))
    folder = share.run / "report"
    folder.mkdir()
    with ThreadPoolExecutor(1) as other:
        with in_turn(folder / "control-0.json"):
            outcome = other.submit(score_job, share)
            time.sleep(0.3)
            assert not outcome.done()
            assert not shares_of(folder / "control.json")
        assert outcome.result(timeout=60).error is None
    assert len(shares_of(folder / "control.json")) == 1


@pytest.mark.slow
def test_a_damaged_share_is_planned_again(job: MakeJob) -> None:
    whole = job("whole")
    score_run(whole.run, metrics=("control",), settings=SETTINGS)
    shared = job("shared")
    for share in control_shares(shared):
        score_job(share)
    first, second, _ = shares_of(shared.run / "report" / "control.json")
    content = json.loads(first.read_text())
    content["tasks"]["0"]["actions"][0] = (content["tasks"]["0"]["actions"][0] + 1) % 4
    first.write_text(json.dumps(content))
    second.write_text(second.read_text()[:40])

    assert score_job(shared).error is None

    assert _told(shared.run) == _told(whole.run)


@pytest.mark.slow
def test_one_that_fails_does_not_stop_the_others(job: MakeJob, tmp_path: Path) -> None:
    jobs = [job("sound"), ScoreJob(**{**vars(job("sound")), "run": tmp_path / "nothing"})]

    outcomes = {outcome.run.name: outcome.error for outcome in score_side_by_side(jobs, local_executor(1))}

    assert outcomes["sound"] is None
    assert "nothing" in (outcomes["nothing"] or "")
    assert read_report(jobs[0].run / "report") is not None


@pytest.mark.parametrize("machine", [socket.gethostname(), "login"])
def test_another_machine_that_does_not_see_the_data_is_named(job: MakeJob, tmp_path: Path, machine: str) -> None:
    unseen = replace(job("a", metrics=("prediction",)), data=tmp_path / "not-mounted", machine=machine)
    named = f"on the machine {socket.gethostname()!r}: no data set in" in (score_job(unseen).error or "")
    assert named == (machine == "login")


@pytest.mark.slow
def test_a_lost_job_is_a_failure_of_its_runs_alone(job: MakeJob) -> None:
    outcomes = list(score_side_by_side([job("lost"), job("sound")], Losing()))

    assert [(outcome.run.name, outcome.error) for outcome in outcomes] == [
        ("sound", None),
        ("lost", "a worker was killed."),
    ]


@pytest.mark.slow
def test_jobs_say_how_far_they_are(job: MakeJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    (folder := tmp_path / "jobs").mkdir()
    sound = side_by_side.score_control

    def look(*given: Any, **named: Any) -> Any:
        def progress(told: Any) -> None:
            named_progress(told)
            seen.extend(f"{name}: {one.what} {one.status}" for name, one in read_progress(folder).items())

        named_progress = named["progress"]
        return sound(*given, **(named | {"progress": progress}))

    monkeypatch.setattr(side_by_side, "score_control", look)
    list(score_side_by_side([job("a")], local_executor(1), progress=folder))

    assert any(one.startswith("control-0: a control, tasks 0 to 1") for one in seen), seen
    assert not list(folder.iterdir())
    assert Run.open(job("a").run).result is not None


@dataclass(frozen=True)
class Noting:
    """An executor that keeps what it is given."""

    given: list[Any]

    def map_unordered(self, function: Callable[[Any], Any], jobs: Iterable[Any]) -> Iterator[Any]:
        for job in jobs:
            self.given.append(job)
            yield function(job)


@pytest.mark.slow
def test_runs_that_are_scored_or_do_not_fit_need_no_job(
    tasks: Dataset, job: MakeJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor, told = Noting([]), list[str]()
    monkeypatch.setattr("dmotion_bench.api.side_by_side.make_executor", lambda *_, **__: executor)
    unfit, paths = (
        write_run(tmp_path / "unfit", tasks, height=64, fingerprint="0" * 64).path,
        [job(name).run for name in ("a", "b")],
    )
    settings = replace(SETTINGS, horizon=2)

    def sent(*runs: Path, keep: bool = True, metrics: tuple[Any, ...] = ("prediction",)) -> list[str]:
        """The names of the runs for which jobs are sent."""
        before = len(executor.given)
        hands = Hands(executor="slurm", workers=2)
        where = Workspace(tmp_path)
        done, failures = score_at_once(
            runs, metrics, settings, where, hands, keep=keep, data=tasks.path, note=told.append, warn=told.append
        )
        assert not failures
        assert set(done) == {*runs} - {unfit}
        return [one.run.name for chain in executor.given[before:] for one in chain]

    assert sent(paths[0]) == ["a"]
    assert told == []
    assert sent(*paths, unfit) == ["b"]
    assert told[0] == "2 of 3 runs need no scoring, so no jobs are sent for them."
    assert told[1].startswith("left out: ")
    assert sent(*paths) == []
    assert sent(*paths, metrics=("rollout",)) == ["a", "b"]
    assert sent(*paths, keep=False) == ["a", "b"]


@pytest.mark.slow
def test_runs_of_one_training_are_one_job(tasks: Dataset, job: MakeJob, tmp_path: Path) -> None:
    made = {"few": "one-shot", "many": "64", "others": "one-shot"}
    for name, labels in made.items():
        write_run(tmp_path / name, tasks, labels=labels, seed=int(name == "others"))
    jobs = [job(name, metrics=("prediction",)) for name in ("few", "others", "many")]
    jobs.append(ScoreJob(**{**vars(jobs[0]), "run": tmp_path / "nothing"}))

    outcomes = list(score_side_by_side(jobs, executor := Noting([])))

    assert [[one.run.name for one in chain] for chain in executor.given] == [["few", "many"], ["others"], ["nothing"]]
    assert [outcome.error is None for outcome in outcomes] == [True, True, True, False]
