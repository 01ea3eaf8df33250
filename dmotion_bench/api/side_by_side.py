"""Many trainings or scorings: in turn, or several at a time by an executor."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import torch

from dmotion_bench.api.scoring import changed_code, compute_device
from dmotion_bench.errors import RunError
from dmotion_bench.execution.executor import JobSize
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress, jobs_folder, watching
from dmotion_bench.execution.local_executor import available_workers
from dmotion_bench.learning.beginning import tell_changes
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.start import TrainingRequest
from dmotion_bench.learning.table import Outcome, Row, rows, train_side_by_side, train_table
from dmotion_bench.scoring.report import Report
from dmotion_bench.scoring.score import scored_report
from dmotion_bench.scoring.settings import Metric, ScoreSettings
from dmotion_bench.scoring.side_by_side import ScoreJob, score_side_by_side
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

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
        device: ``auto``, ``cpu`` or ``cuda``.
        count: Told how many jobs are done, and of how many.
        watch: Told how far those are that run, by their names.
    """

    executor: str | None = None
    workers: int | None = None
    device: str = "auto"
    count: Callable[[int, int], None] = field(default=_nobody)
    watch: Callable[[Mapping[str, JobProgress]], None] = field(default=_nobody)

    def at_once(self, jobs: int) -> int | None:
        """How many jobs beside each other pay: as many as there are processors and memory for, also on one GPU.

        A small network's step is over on a GPU before a processor has told it the next one, so that many processes
        together keep it busy (docs/experiments/speed.md).
        """
        if self.workers:
            return self.workers
        if self.executor not in (None, "local"):
            return None
        most = min(available_workers(_GIGABYTES), jobs)
        if _on_gpu(self.device):
            free, _ = torch.cuda.mem_get_info()
            most = min(most, int(free / 2**30 / _GPU_GIGABYTES))
        return max(1, most)

    def in_turn(self, jobs: int) -> bool:
        """Whether this process does one job after the other."""
        return self.executor in (None, "local") and self.at_once(jobs) == 1


def _on_gpu(device: str) -> bool:
    return device == "cuda" or (device == "auto" and torch.cuda.is_available())


def gpus_of_a_job(hands: Hands) -> int:
    """How many GPUs each job asks a cluster for; this machine's processes see all of them."""
    return int(hands.device == "cuda")


def table_rows(dataset: Dataset) -> list[Row]:
    """Every model with each of its label budgets on a data set."""
    return list(rows(dataset))


def train_every(
    request: TrainingRequest,
    dataset: Dataset,
    workspace: Workspace,
    hands: Hands,
    train: Callable[[Run], object],
    trackers: tuple[str, ...] = (),
    warn: Callable[[str], None] = _nobody,
) -> Iterator[Outcome]:
    """Train every model with each of its label budgets; one that fails does not stop the rest.

    Args:
        request: What holds for all of them; its model and labels are theirs.
        dataset: What they learn from.
        workspace: Where the runs are.
        hands: Who trains. Rows of one model are one job.
        train: Trains one run to its end, where this process does it.
        trackers: That are told the curves, where others do it.
        warn: Told in a sentence of a run, where others do it, whose model was changed since it began.

    Yields:
        What became of each row, as they end.
    """
    models = len({row.model for row in table_rows(dataset)})
    if hands.in_turn(models):
        yield from train_table(request, dataset, workspace, train)
        return
    with contextlib.closing(_trained_at_once(request, dataset, workspace, hands, models, trackers)) as outcomes:
        for outcome in outcomes:
            if outcome.run is not None:
                tell_changes(outcome.run, warn)
            yield outcome


def _trained_at_once(
    request: TrainingRequest,
    dataset: Dataset,
    workspace: Workspace,
    hands: Hands,
    models: int,
    trackers: tuple[str, ...],
) -> Generator[Outcome]:
    if not request.stream and not dataset.cache_file.lacking():
        dataset.cache()  # once, and not by every job
    threads, total = request.threads or 1, len(table_rows(dataset))
    size = JobSize(
        processors=threads, gigabytes=_CLUSTER_GIGABYTES, minutes=_CLUSTER_MINUTES, gpus=gpus_of_a_job(hands)
    )
    with jobs_folder(workspace) as folder:
        name = hands.executor or "local"
        executor = make_executor(name, hands.at_once(models), scratch=folder / name, size=size)
        hands.count(0, total)
        outcomes = train_side_by_side(
            request,
            dataset,
            workspace,
            executor,
            threads=threads,
            device=hands.device,
            progress=folder,
            trackers=trackers,
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


def score_at_once(
    paths: Sequence[Path],
    metrics: tuple[Metric, ...] | None,
    settings: ScoreSettings,
    workspace: Workspace,
    hands: Hands,
    *,
    batch_size: int = 64,
    data: Path | None = None,
    note: Callable[[str], None] = _nobody,
    warn: Callable[[str], None] = _nobody,
) -> tuple[dict[Path, Report], dict[str, str]]:
    """Score runs by an executor; reports that are up to date are kept.

    Args:
        paths, metrics, settings, batch_size, data, note, warn: See ``scoring.score_runs``.
        workspace: Where the jobs meet.
        hands: Who scores.

    Returns:
        See ``scoring.score_runs``.
    """
    name = hands.executor or "local"
    if name == "local":
        compute_device(hands.device)  # refuses what is not here; this machine says nothing of those of a cluster
    where = "cuda" if _on_gpu(hands.device) else "cpu"
    jobs = [
        ScoreJob(
            run=path.absolute(),
            metrics=metrics,
            settings=settings,
            renew=False,
            data=None if data is None else data.absolute(),
            batch_size=batch_size,
            device=where,
        )
        for path in paths
    ]
    for told in dict.fromkeys(filter(None, map(_changed_code_at, paths))):
        warn(told)
    own = {job.run: path for job, path in zip(jobs, paths, strict=True)}
    reports: dict[Path, Report] = {}
    failures: dict[str, str] = {}
    size = JobSize(gigabytes=_CLUSTER_GIGABYTES, minutes=_CLUSTER_MINUTES, gpus=gpus_of_a_job(hands))
    with jobs_folder(workspace) as folder:
        executor = make_executor(name, hands.at_once(len(paths)), scratch=folder / name, size=size)
        hands.count(0, len(jobs))
        outcomes = score_side_by_side(jobs, executor, progress=folder)
        with watching(folder, hands.watch), contextlib.closing(outcomes):
            for done, outcome in enumerate(outcomes, start=1):
                hands.count(done, len(jobs))
                path = own[outcome.run]
                if outcome.error is None:
                    reports[path] = scored_report(path, settings.split, data, settings.control.column)
                elif outcome.unfit and data is not None:
                    warn(f"left out: {outcome.error}")
                else:
                    failures[path.name] = outcome.error
                    note(f"{path.name}: {outcome.error}")
    return {path: reports[path] for path in paths if path in reports}, failures
