"""Many trainings or scorings, or the tasks of a reference: in turn, or several at a time by an executor."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import torch

from dmotion_bench.api.contract import (
    begins_all_the_same,
    breaches_before,
    train_rows_explained,
    with_breach,
)
from dmotion_bench.api.progress import Progress
from dmotion_bench.api.scoring import changed_code, compute_device, names_apart, score_references
from dmotion_bench.errors import RunError
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.executor import Executor, JobSize
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress, jobs_folder, watching
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, require_enough, resolve
from dmotion_bench.learning.training.table import Outcome, Row, job_of, rows, train_side_by_side, train_table
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.figures import Figures
from dmotion_bench.scoring.reference_control import is_kept
from dmotion_bench.scoring.reference_job import reference_jobs, score_reference_job
from dmotion_bench.scoring.report import Report
from dmotion_bench.scoring.score import scored_report
from dmotion_bench.scoring.settings import Metric, ScoreSettings
from dmotion_bench.scoring.side_by_side import (
    ScoreJob,
    ScoreOutcome,
    control_shares,
    score_side_by_side,
    settled_already,
)
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

THREADS: Final = 1
"""Of each of many trainings, so that its weights do not depend on how many of them run beside each other."""

_GIGABYTES: Final = 2.0  # that a job takes beside others
_GPU_GIGABYTES: Final = 4.0  # likewise, of a GPU's memory
_CLUSTER_GIGABYTES: Final = 16
_CLUSTER_MINUTES: Final = 24 * 60


def _nobody(*_: object) -> None:
    """Nobody wants to know."""


@dataclass(frozen=True, kw_only=True)
class Hands:
    """Who does many jobs, and who is told how far they are.

    Attributes:
        executor: ``local``, ``ray`` or ``slurm``; None for ``local``.
        workers: Jobs at a time; None: as many as pay, or as the cluster decides.
        device: ``auto``, ``cpu`` or ``cuda``. On a cluster only ``cuda`` means a GPU, whatever this machine has.
        count: Told how many jobs are done, and of how many.
        watch: Told how far those are that run, by their names.
    """

    executor: str | None = None
    workers: int | None = None
    device: str = "auto"
    count: Callable[[int, int], None] = field(default=_nobody)
    watch: Callable[[Mapping[str, JobProgress]], None] = field(default=_nobody)

    @property
    def on_cluster(self) -> bool:
        """Whether other machines do the jobs, of whose devices this one says nothing."""
        return self.executor not in (None, "local")

    @property
    def job_device(self) -> str:
        """Where a job computes: ``cuda``, for which a cluster is asked for a GPU, or ``cpu``."""
        here = self.device == "auto" and not self.on_cluster and torch.cuda.is_available()
        return "cuda" if here or self.device == "cuda" else "cpu"

    def job_size(self, *, processors: int = 1) -> JobSize:
        """What a cluster is asked for, for each job."""
        return JobSize(
            processors=processors,
            gigabytes=_CLUSTER_GIGABYTES,
            minutes=_CLUSTER_MINUTES,
            gpus=int(self.job_device == "cuda"),
        )

    def at_once(self, jobs: int) -> int | None:
        """How many jobs beside each other pay: as many as there are processors and memory for, also on one GPU.

        A small network's step is over on a GPU before a processor has told it the next one, so that many processes
        together keep it busy (docs/experiments/speed.md).
        """
        if self.workers:
            return self.workers
        if self.on_cluster:
            return None
        most = min(available_workers(_GIGABYTES), jobs)
        if self.job_device == "cuda" and torch.cuda.is_available():
            free, _ = torch.cuda.mem_get_info()
            most = min(most, int(free / 2**30 / _GPU_GIGABYTES))
        return max(1, most)

    def in_turn(self, jobs: int) -> bool:
        """Whether this process does one job after the other."""
        return not self.on_cluster and self.at_once(jobs) == 1


def table_rows(dataset: Dataset, seeds: Sequence[int] | None = None) -> list[Row]:
    """Every model with each of its label budgets on a data set, with each seed, or with that of the request."""
    return list(rows(dataset, (None,) if seeds is None else tuple(seeds)))


def seed_rows(request: TrainingRequest, dataset: Dataset, seeds: Sequence[int]) -> list[Row]:
    """The trainings of a request with each seed.

    Raises:
        UnknownName, InvalidSetting, UsageError: The request asks for what cannot be trained.
    """
    require_enough(request, dataset)
    resolve(request, dataset)
    return [Row(model=request.model, labels=request.labels or "", seed=seed) for seed in seeds]


def train_every(
    request: TrainingRequest,
    chosen: Sequence[Row],
    dataset: Dataset,
    workspace: Workspace,
    hands: Hands,
    train: Callable[[Run], object],
    trackers: tuple[str, ...] = (),
    warn: Callable[[str], None] = _nobody,
    *,
    loaders: int | None = None,
) -> Iterator[Outcome]:
    """Train every row of a table; one that fails does not stop the rest.

    Each training computes with one thread if the request names no number, so that its weights do not depend on how
    many train beside each other.

    Args:
        request: What holds for all of them; its model, labels and seed are theirs.
        chosen: The rows, those of one model and seed after each other.
        dataset: What they learn from.
        workspace: Where the runs are.
        hands: Who trains. Rows of one model and seed are one job.
        train: Trains one run to its end, where this process does it.
        trackers: That are told the curves, where others do it.
        warn: Told in a sentence, where others do it, of a model that breaks its contract before its trainings begin,
            and of what those were warned of: code or packages that changed since a run began, or that differ there.
        loaders: Threads that read the compressed files of a run that streams them, where others do it.

    Yields:
        What became of each row, as they end.
    """
    jobs = len(set(map(job_of, chosen)))
    if hands.in_turn(jobs):

        def train_alone(run: Run) -> None:
            with using_threads(_threads(request)):
                train(run)

        yield from train_table(request, dataset, workspace, train_alone, chosen)
        return
    breaches = breaches_before(((row.request(request), dataset) for row in chosen), workspace)
    for breach in breaches.values():
        warn(begins_all_the_same(breach))
    at_once = _trained_at_once(request, chosen, dataset, workspace, hands, jobs, trackers, loaders)
    with contextlib.closing(at_once) as outcomes:
        for outcome in outcomes:
            for told in outcome.warnings:
                warn(told)
            yield with_breach(outcome, breaches)


def _threads(request: TrainingRequest) -> int:
    """That each of many trainings computes with."""
    return request.threads or THREADS


def _trained_at_once(
    request: TrainingRequest,
    chosen: Sequence[Row],
    dataset: Dataset,
    workspace: Workspace,
    hands: Hands,
    jobs: int,
    trackers: tuple[str, ...],
    loaders: int | None,
) -> Generator[Outcome]:
    if not request.stream and not dataset.cache_file.lacking():
        dataset.cache()  # once, and not by every job
    threads, total = _threads(request), len(chosen)
    with jobs_folder(workspace) as folder:
        name = hands.executor or "local"
        size = hands.job_size(processors=threads)
        executor = make_executor(name, hands.at_once(jobs), scratch=folder / name, size=size)
        hands.count(0, total)
        outcomes = train_side_by_side(
            request,
            chosen,
            dataset,
            workspace,
            executor,
            threads=threads,
            device=hands.job_device,
            progress=folder,
            trackers=trackers,
            loaders=loaders,
            how=train_rows_explained,
        )
        with watching(folder, hands.watch), contextlib.closing(outcomes):
            for done, outcome in enumerate(outcomes, start=1):
                hands.count(done, total)
                yield outcome


def _changed_code_at(path: Path) -> str | None:
    try:
        return changed_code(Run.open(path))
    except RunError:  # it is said when the run is scored
        return None


def scored_in_turn(
    paths: Sequence[Path],
    metrics: tuple[Metric, ...] | None,
    settings: ScoreSettings,
    hands: Hands,
    *,
    keep: bool = True,
    data: Path | None = None,
) -> bool:
    """Whether one process scores all; arguments as of ``score_at_once``, which several can share otherwise."""
    return hands.in_turn(_pieces(_score_jobs(paths, metrics, settings, hands, keep=keep, data=data)))


def _score_jobs(
    paths: Sequence[Path],
    metrics: tuple[Metric, ...] | None,
    settings: ScoreSettings,
    hands: Hands,
    *,
    keep: bool,
    data: Path | None,
    batch_size: int = 1,
) -> list[ScoreJob]:
    """A job for each run; arguments as of ``score_at_once``."""
    return [
        ScoreJob(
            run=path.absolute(),
            metrics=metrics,
            settings=settings,
            renew=not keep,
            data=None if data is None else data.absolute(),
            batch_size=batch_size,
            device=hands.job_device,
        )
        for path in paths
    ]


def _pieces(jobs: Sequence[ScoreJob]) -> int:
    """How many workers find something to do at a time: a run each or, where there are more of these, control tasks.

    Where each processor has a run, control tasks are not counted: for that every run and its data are opened.
    """
    if len(jobs) >= available_workers(_GIGABYTES):
        return len(jobs)
    return max(len(jobs), sum(1 for job in jobs for _ in control_shares(job)))


def score_at_once(
    paths: Sequence[Path],
    metrics: tuple[Metric, ...] | None,
    settings: ScoreSettings,
    workspace: Workspace,
    hands: Hands,
    *,
    keep: bool = True,
    batch_size: int = 64,
    data: Path | None = None,
    note: Callable[[str], None] = _nobody,
    warn: Callable[[str], None] = _nobody,
) -> tuple[dict[Path, Report], dict[Path, str]]:
    """Score runs by an executor, which shares the runs and, of control, groups of tasks.

    Args:
        paths, metrics, settings, keep, batch_size, data, note, warn: See ``scoring.score_runs``.
        workspace: Where the jobs meet.
        hands: Who scores.

    Returns:
        See ``scoring.score_runs``.
    """
    name = hands.executor or "local"
    if not hands.on_cluster:
        compute_device(hands.device)  # refuses what is not here
    jobs = _score_jobs(paths, metrics, settings, hands, keep=keep, data=data, batch_size=batch_size)
    for told in dict.fromkeys(filter(None, map(_changed_code_at, paths))):
        warn(told)
    own, names = {job.run: path for job, path in zip(jobs, paths, strict=True)}, names_apart(paths)
    settled = {job.run: outcome for job in jobs if (outcome := settled_already(job)) is not None}
    left = [job for job in jobs if job.run not in settled]

    def outcomes_by(executor: Executor, progress: Path) -> Generator[ScoreOutcome]:
        yield from settled.values()
        if left:
            yield from score_side_by_side(left, executor, progress=progress)

    if settled and hands.on_cluster:
        note(f"{len(settled)} of {len(jobs)} runs need no scoring, so no jobs are sent for them.")
    reports: dict[Path, Report] = {}
    failures: dict[Path, str] = {}
    with jobs_folder(workspace) as folder:
        executor = make_executor(name, hands.at_once(_pieces(left)), scratch=folder / name, size=hands.job_size())
        hands.count(0, len(jobs))
        outcomes = outcomes_by(executor, folder)
        with watching(folder, hands.watch), contextlib.closing(outcomes):
            for done, outcome in enumerate(outcomes, start=1):
                hands.count(done, len(jobs))
                path = own[outcome.run]
                if outcome.error is None:
                    reports[path] = scored_report(path, settings.split, data, settings.control.column)
                elif outcome.unfit and data is not None and keep and len(paths) > 1:
                    warn(f"left out: {outcome.error}")
                else:
                    failures[path] = outcome.error
                    note(f"{names[path]}: {outcome.error}")
    return {path: reports[path] for path in paths if path in reports}, failures


def score_references_at_once(
    names: Sequence[str],
    data: Path,
    scoring: ControlScoring,
    workspace: Workspace,
    hands: Hands,
    progress: Progress = None,
) -> dict[str, Figures]:
    """Score references by an executor, which shares groups of their tasks; in turn where that does not pay.

    Args:
        names, data, scoring: See ``scoring.score_references``.
        workspace: Where the jobs meet.
        hands: Who scores.
        progress: Told how far they are where they are scored in turn.

    Returns:
        See ``scoring.score_references``.

    Raises:
        JobsLost: The workers at some jobs were killed again and again; else as ``scoring.score_references``.
    """
    dataset = Dataset.open(data)
    every = [job for name in dict.fromkeys(names) for job in reference_jobs(name, dataset, scoring)]
    jobs = [job for job in every if not is_kept(job.name, dataset, scoring, job.tasks)]
    if jobs and not hands.in_turn(len(jobs)):
        with jobs_folder(workspace) as folder:
            name = hands.executor or "local"
            executor = make_executor(name, hands.at_once(len(jobs)), scratch=folder / name, size=hands.job_size())
            hands.count(0, len(jobs))
            told = [replace(job, progress=folder / f"{number}.json") for number, job in enumerate(jobs)]
            results = executor.map_unordered(score_reference_job, told)
            with watching(folder, hands.watch), contextlib.closing(results):
                for done, (_, failure) in enumerate(results, start=1):
                    if failure is not None:
                        raise failure
                    hands.count(done, len(jobs))
    return score_references(names, data, scoring, progress)  # what was shared is gathered
