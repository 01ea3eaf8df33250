"""References by several processes: the bytes of one process, whatever happens to a job on the way."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import dmbench, ended_by_ctrl_c, interrupted_once, start_dmbench
from mortal_workers import Deadly, Losing, engine

from dmotion_bench.api import side_by_side
from dmotion_bench.api.side_by_side import Hands, score_references_at_once
from dmotion_bench.errors import InvalidSetting, JobsLost
from dmotion_bench.planning.journal import Journal
from dmotion_bench.planning.tasks import load_problems
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring import reference_control
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.kept_control import journal_of, kept_by_reference, shares_of
from dmotion_bench.scoring.reference_control import known_references, score_reference
from dmotion_bench.scoring.reference_job import reference_jobs, score_reference_job
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

FEW = ("samples=3", "horizon=2", "iterations=1", "elites=2")
SCORING = ControlScoring(tasks=5, steps=3, group=2, planner_set=FEW)
NAMES = ("oracle", "random")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read only; ``tasks`` is a copy."""
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=40, frames=32, tasks=12
    )
    path = tmp_path_factory.mktemp("data") / "grid"
    record_dataset(path, recipe)
    return path


@pytest.fixture
def tasks(recorded: Path, tmp_path: Path) -> Dataset:
    """A Grid World with tasks; its cache is empty."""
    return Dataset.open(shutil.copytree(recorded, tmp_path / "data" / "grid"))


def kept(dataset: Dataset) -> dict[str, bytes]:
    """What is kept of control, by the name of the file."""
    return {path.name: path.read_bytes() for path in sorted((dataset.path / "cache").glob("control-*"))}


@pytest.fixture(scope="module")
def in_turn(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    dataset = Dataset.open(shutil.copytree(recorded, tmp_path_factory.mktemp("in-turn") / "grid"))
    for name in NAMES:
        score_reference(name, dataset, SCORING)
    return kept(dataset)


def test_jobs_are_whole_groups_and_their_results_those_of_one_process(
    tasks: Dataset, in_turn: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in NAMES:
        jobs = reference_jobs(name, tasks, SCORING)
        assert [job.tasks for job in jobs] == [(0, 1), (2, 3), (4,)]
        for job in reversed(jobs):
            assert score_reference_job(job) == (tasks.path, None)
        assert len(shares_of(kept_by_reference(name, tasks, SCORING))) == 3
    assert known_references(tasks, SCORING, load_problems(tasks, 5)) == ("idle", "random", "oracle", "scripted")
    assert [score_reference(name, tasks, SCORING).planned for name in NAMES] == [0, 0]
    assert kept(tasks) == in_turn


@pytest.mark.slow
def test_a_killed_worker_changes_no_byte(tasks: Dataset, in_turn: dict[str, bytes], tmp_path: Path) -> None:
    executor = Deadly(engine("local", tmp_path), tmp_path / "died")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(side_by_side, "make_executor", lambda *_, **__: executor)
        figures = score_references_at_once(NAMES, tasks.path, SCORING, Workspace(tmp_path), Hands(workers=2))
    assert (tmp_path / "died").exists()
    assert list(figures) == [*NAMES]
    assert kept(tasks) == in_turn


def test_what_is_done_is_not_done_again(tasks: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    score_reference("oracle", tasks, replace(SCORING, tasks=2))
    given: list[Any] = []

    def executor(*_: Any, **__: Any) -> Any:
        return type(
            "Noting",
            (),
            {"map_unordered": lambda _, function, jobs: (given.append(job) or function(job) for job in jobs)},
        )()

    monkeypatch.setattr(side_by_side, "make_executor", executor)
    for _ in range(2):
        score_references_at_once(["oracle"], tasks.path, SCORING, Workspace(tmp_path), Hands(workers=2))
    assert [job.tasks for job in given] == [(2, 3), (4,)]


def test_more_tasks_than_ten_groups_are_kept_in_their_order(tasks: Dataset) -> None:
    """By name, the share of task 10 comes before that of task 2."""
    many = replace(SCORING, tasks=12, group=1, steps=1)
    for job in reference_jobs("random", tasks, many):
        assert score_reference_job(job)[1] is None
    score_reference("random", tasks, many)
    (content,) = map(json.loads, kept(tasks).values())
    assert [*content["tasks"]] == [str(number) for number in range(12)]


def test_a_share_goes_on_where_one_process_stopped(
    tasks: Dataset, in_turn: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(Exception):
        """The process is gone."""

    def die(progress: Any) -> None:
        if progress.steps == 4:
            raise Killed

    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    with contextlib.suppress(Killed):
        score_reference("random", tasks, SCORING, progress=die)
    job = reference_jobs("random", tasks, SCORING)[0]
    told: list[Any] = []
    reference_control.score_share_of_reference("random", tasks, SCORING, job.tasks, progress=told.append)
    assert told[0].steps == 6
    score_reference("random", tasks, SCORING)
    (name,) = kept(tasks)
    assert kept(tasks)[name] == in_turn[name]


def test_whoever_reads_while_shares_are_gathered_misses_none(tasks: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    for job in reference_jobs("random", tasks, SCORING):
        score_reference_job(job)
    file = kept_by_reference("random", tasks, SCORING)

    def read_first(*given: Any, **named: Any) -> Journal:
        monkeypatch.undo()
        read = Journal(*given, **named)
        score_reference("random", tasks, SCORING)  # as another process does
        return read

    monkeypatch.setattr("dmotion_bench.scoring.kept_control.Journal", read_first)
    journal = journal_of(file, "random", tasks, SCORING, None)
    assert not shares_of(file)
    assert [journal.reached(number) for number in range(5)] == [3] * 5


def test_a_failure_is_said_as_in_one_process(tasks: Dataset, tmp_path: Path) -> None:
    scoring = replace(SCORING, planner="mppi", planner_set=())
    with pytest.raises(InvalidSetting) as alone:
        score_reference("oracle", tasks, scoring)
    with pytest.raises(InvalidSetting, match="the planner 'mppi' needs continuous actions") as shared:
        score_references_at_once(["oracle"], tasks.path, scoring, Workspace(tmp_path), Hands(workers=2))
    assert str(shared.value) == str(alone.value)


def test_jobs_that_are_lost_are_not_done_by_the_command_itself(
    tasks: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(side_by_side, "make_executor", lambda *_, **__: Losing())
    with pytest.raises(JobsLost):
        score_references_at_once(["random"], tasks.path, SCORING, Workspace(tmp_path), Hands(workers=2))
    assert [path.stem[-2:] for path in shares_of(kept_by_reference("random", tasks, SCORING))] == ["-2", "-4"]


@pytest.mark.slow
def test_ctrl_c_ends_all_jobs_and_the_same_command_goes_on(
    tasks: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = (
        one for setting in ("samples=2", "elites=1", "iterations=1", "horizon=1") for one in ("--planner-set", setting)
    )
    words = ("score", "oracle", "--metrics", "control", *quick, "--json")
    shared_words = (*words, "--workers", "2")
    process = start_dmbench(shared_words, tmp_path)

    def shares() -> list[Path]:
        return list(tmp_path.glob("data/grid/cache/control-*-?.json"))

    workers = interrupted_once(process, lambda: bool(shares()), signal.SIGINT)
    ended_by_ctrl_c(process, workers, tmp_path)
    assert shares()
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    shared = dmbench(shared_words, capsys, monkeypatch)
    assert not shares()
    shared_bytes = kept(tasks)
    for path in (tasks.path / "cache").glob("control-*"):
        path.unlink()
    alone = dmbench(words, capsys, monkeypatch)
    assert (shared.out, shared_bytes) == (alone.out, kept(tasks))
