"""Many trainings: all registered models with each of their label budgets, or some with several seeds.

Each is a run, and a row of a table. Rows are independent. A row that is trained already is taken as it is, one that was
interrupted goes on, one that fails is noted with its sentence, and the next is trained.

Several can be trained beside each other, by an executor. The rows of one model and seed stay one job, in their order:
they share the training that needs no labels (``shared_pretraining.py``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import socket
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.errors import (
    DatasetError,
    DatasetMissing,
    DmbenchError,
    FolderInUse,
    JobsLost,
    RunError,
    StorageFull,
)
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.execution.refusals import reason
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import (
    TrainingRequest,
    default_path,
    open_run,
    require_labels,
    resolve,
    training_data,
)
from dmotion_bench.learning.training.beginning import finished_result, is_finished, tell_changes, tell_machine
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.registry import model_class, model_names
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.versions import deciding_versions
from dmotion_bench.workspace import RUN_MANIFEST, Workspace

SHOTS = ("one-shot", "5-shot", "20-shot")
BUDGETS = {Supervision.NONE: SHOTS, Supervision.FEW: SHOTS, Supervision.ACTIONS: ("100%", "10%")}
"""Label budgets of models that name none of their own."""

TRANSITIONS = ("64", "16", "256")
"""Label budgets of models that take demonstrations where the actions are continuous."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A model under a label budget, trained with a seed.

    Attributes:
        model: Registry name.
        labels: The budget; empty for the model's usual one, or where the model could not be loaded and its budgets are
            not known.
        seed: None for that of the request.
    """

    model: str
    labels: str
    seed: int | None = None

    def request(self, common: TrainingRequest) -> TrainingRequest:
        """What is asked for, where something else is the same for all rows."""
        seed = common.seed if self.seed is None else self.seed
        return dataclasses.replace(common, model=self.model, labels=self.labels or None, seed=seed)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The result of training a row.

    Attributes:
        row: Which one.
        run: Its run, where there is one.
        error: Why it failed, in a sentence; None if it did not.
        busy: Whether that is because another process trains the run now.
        warnings: In sentences, what whoever trained it was warned of; empty where it was trained in turn.
    """

    row: Row
    run: Run | None
    error: str | None = None
    busy: bool = False
    warnings: tuple[str, ...] = ()


def budgets(kind: type[ForwardModel[Any]], actions: ActionSpec | None) -> tuple[str, ...]:
    """The label budgets that a class of models is ranked under on a data set with such actions."""
    if actions is None:
        return ("none",) if kind.supervision is Supervision.NONE else ()
    named = kind.budgets or BUDGETS[kind.supervision]
    if isinstance(actions, Continuous):
        return tuple(name for name in named if not name.endswith("-shot")) or TRANSITIONS
    return named


def rows(dataset: Dataset, seeds: Sequence[int | None] = (None,)) -> Iterator[Row]:
    """Every registered model with each seed under each of its budgets; where actions are not known, what needs none."""
    for name in model_names():
        named: tuple[str, ...] = ("",)  # of what cannot be loaded; said when the row is trained
        with contextlib.suppress(DmbenchError):
            kind = model_class(name)
            named = budgets(kind, dataset.spec.actions)
        for seed, labels in itertools.product(seeds, named):
            yield Row(model=name, labels=labels, seed=seed)


def train_table(
    request: TrainingRequest,
    dataset: Dataset,
    workspace: Workspace,
    train: Callable[[Run], object],
    chosen: Iterable[Row] | None = None,
) -> Iterator[Outcome]:
    """Train every row in turn.

    Args:
        request: What holds for all rows: preset and split; model, labels and the seed, if it has one, are the row's.
        dataset: What all learn from.
        workspace: Where the runs are.
        train: Trains one run to its end.
        chosen: Which rows; all by default.
    """
    for row in rows(dataset) if chosen is None else chosen:
        run = None
        try:
            run = open_run(row.request(request), dataset, None, workspace)
            train(run)
        except StorageFull:
            raise
        except FolderInUse:
            yield Outcome(row=row, run=run, error="being trained by another process.", busy=True)
        except Exception as error:  # a stranger's model may raise anything; the others are to be trained
            yield Outcome(row=row, run=run, error=reason(error))
        else:
            yield Outcome(row=row, run=run)


@dataclass(frozen=True, kw_only=True)
class TableJob:
    """The rows of one model and seed, as plain values, so that they can be sent anywhere.

    Attributes:
        request, rows: See ``train_table``.
        dataset, workspace: Their folders.
        device: Where it computes.
        threads: That a run computes with for which nobody asked for another number.
        progress: The file in which it says how far it is; None: nowhere.
        trackers: See ``train``.
        loaders: Threads that read the compressed files of a run that streams them; None for the usual number.
        versions: Of the packages that decide weights, where the command runs.
    """

    request: TrainingRequest
    rows: tuple[Row, ...]
    dataset: Path | str
    workspace: Path
    device: str
    threads: int
    progress: Path | None
    trackers: tuple[str, ...] = ()
    loaders: int | None = None
    versions: Mapping[str, str] = field(default_factory=deciding_versions)


def _dataset_here(job: TableJob) -> Dataset:
    """The data set of a job, as this machine sees it.

    Raises:
        DatasetMissing: This machine does not see it.
        DatasetError: It cannot be read.
    """
    try:
        return Dataset.open(job.dataset)
    except (DatasetMissing, OSError) as error:
        raise DatasetMissing(
            f"the machine {socket.gethostname()!r} does not see the data set {str(job.dataset)!r}; all machines must "
            "see the workspace and its data under the same path, so mount them there and run the same command again."
        ) from error


@dataclass(frozen=True, kw_only=True)
class RowResult:
    """What ``Outcome`` says, as plain values.

    Attributes:
        path: The folder of the run, where there is one.
        row, error, busy, warnings: See ``Outcome``.
    """

    row: Row
    path: Path | None
    error: str | None
    busy: bool = False
    warnings: tuple[str, ...] = ()

    def outcome(self) -> Outcome:
        """The outcome, on a machine that sees the run."""
        return Outcome(row=self.row, run=self._run(), error=self.error, busy=self.busy, warnings=self.warnings)

    def _run(self) -> Run | None:
        """None, too, if the row failed so early that the run was not written."""
        if self.path is None:
            return None
        try:
            return Run.open(self.path)
        except RunError:
            if self.error is None:
                raise
            return None


def train_rows(
    job: TableJob, around: Callable[[Run], AbstractContextManager[object]] = lambda _: contextlib.nullcontext()
) -> list[RowResult]:
    """Train the rows of a job in the present process, which computes with as many threads as before afterwards.

    Args:
        job: Its rows.
        around: Entered for each run that is trained; it may say better what goes wrong.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(job.threads)
    try:
        return _rows_trained(job, around)
    finally:
        torch.set_num_threads(before)


def _rows_trained(job: TableJob, around: Callable[[Run], AbstractContextManager[object]]) -> list[RowResult]:
    told = ProgressFile(job.progress)
    warnings = defaultdict[Path | None, list[str]](list)
    try:
        dataset = _dataset_here(job)
    except DatasetError as error:
        return [RowResult(row=row, path=None, error=str(error)) for row in job.rows]

    def complete(run: Run) -> None:
        warn = warnings[run.path].append
        if finished_result(run, ready=lambda: require_labels(run, dataset, job.loaders), warn=warn) is None:
            tell_machine(job.versions, warn)
            fabric = launch(job.device)
            with around(run):
                data = training_data(run, dataset, job.loaders)
                train(run, data, fabric, lambda report: told.tell(_said(run, report)), job.trackers)

    try:
        outcomes = list(train_table(job.request, dataset, Workspace(job.workspace), complete, job.rows))
    finally:
        told.end()
    results = []
    for one in outcomes:
        path = None if one.run is None else one.run.path
        results.append(
            RowResult(row=one.row, path=path, error=one.error, busy=one.busy, warnings=tuple(warnings[path]))
        )
    return results


def train_side_by_side(
    request: TrainingRequest,
    chosen: Iterable[Row],
    dataset: Dataset,
    workspace: Workspace,
    executor: Executor,
    *,
    threads: int = 1,
    device: str = "auto",
    progress: Path | None = None,
    trackers: tuple[str, ...] = (),
    loaders: int | None = None,
    how: Callable[[TableJob], list[RowResult]] = train_rows,
) -> Generator[Outcome]:
    """Train every row, several models and seeds at a time; the outcomes come as they are ready.

    A run's weights are those of ``train_table`` with as many threads. Where all rows of a model and seed are trained
    already, no job is started for them: on a cluster it would wait for a machine to find nothing to do.

    Args:
        request, dataset, workspace: See ``train_table``.
        chosen: The rows, those of one model and seed after each other.
        executor: Runs the jobs; all its machines see the data set and the workspace under the same paths.
        threads: That each training computes with.
        device: Where.
        progress: A folder in which the jobs say how far they are (``job_progress.watching``); None: nowhere.
        trackers: See ``train``.
        loaders: Threads of each that read the compressed files of a run that streams them; None for the usual number.
        how: Does a job.
    """
    jobs = []
    for (model, seed), own in itertools.groupby(chosen, key=job_of):
        together = tuple(own)
        if trained := _if_all_trained(request, together, dataset, workspace):
            yield from trained
            continue
        job = TableJob(
            request=request,
            rows=together,
            dataset=dataset.where if isinstance(dataset.where, str) else dataset.where.absolute(),
            workspace=workspace.root.absolute(),
            device=device,
            threads=threads,
            progress=None if progress is None else progress / f"{model}{'' if seed is None else f'-s{seed}'}.json",
            trackers=trackers,
            loaders=loaders,
        )
        jobs.append(job)
    if jobs:
        yield from train_jobs(jobs, executor, how)


def _if_all_trained(
    request: TrainingRequest, chosen: Iterable[Row], dataset: Dataset, workspace: Workspace
) -> list[Outcome]:
    """The outcomes of rows that are all trained to their end, and none if one is not; no folder is changed."""
    outcomes = []
    for row in chosen:
        wanted = row.request(request)
        try:
            if not (default_path(wanted, resolve(wanted, dataset), workspace) / RUN_MANIFEST).exists():
                return []
            run = open_run(wanted, dataset, None, workspace)
            if not is_finished(run):
                return []
        except Exception:  # whatever it is, of a stranger's model too: the job meets it again and says it
            return []
        warnings: list[str] = []
        tell_changes(run, warnings.append)
        outcomes.append(Outcome(row=row, run=run, warnings=tuple(warnings)))
    return outcomes


def job_of(row: Row) -> tuple[str, int | None]:
    """What the rows of one job have in common."""
    return row.model, row.seed


def train_jobs(
    jobs: Sequence[TableJob], executor: Executor, how: Callable[[TableJob], list[RowResult]] = train_rows
) -> Generator[Outcome]:
    """Do jobs of several tables, too; the outcomes of all their rows come as they are ready.

    Those of jobs whose workers were killed again and again come last.

    Args:
        jobs: To be done.
        executor: Runs them.
        how: Does one; a function of a module, which other processes can import.
    """
    results = executor.map_unordered(how, jobs)
    warned = set[str]()  # of a machine, which several jobs say
    with contextlib.closing(results):
        try:
            for found in results:
                for one in found:
                    new = tuple(told for told in one.warnings if told not in warned)
                    warned.update(new)
                    yield dataclasses.replace(one, warnings=new).outcome()
        except JobsLost as lost:
            for job in lost.jobs:
                yield from _what_is_trained(job, lost)


def _what_is_trained(job: TableJob, why: JobsLost) -> Iterator[Outcome]:
    """The outcomes of a job that is lost: some of its rows may have been trained before."""

    def look(run: Run) -> None:
        if run.result is None:
            raise why

    return train_table(job.request, Dataset.open(job.dataset), Workspace(job.workspace), look, job.rows)


def _said(run: Run, report: StepReport) -> JobProgress:
    return report.as_progress(f"{run.spec.model} {run.spec.labels}, seed {run.spec.seed}")
