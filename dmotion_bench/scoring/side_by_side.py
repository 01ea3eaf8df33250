"""Scoring many runs beside each other: a job for each run and, before it, one for each group of its control tasks.

Jobs are plain values. A group's job keeps what it did in a journal of its own beside the run's report
(``planning/journal.py``); the run's job takes these over and has nothing left to plan. So the figures are those of
runs that are scored in turn, and a job that was killed goes on where it stopped, also one of a run that was scored
in turn until then.

Runs that share a training are one job, which scores one after the other: what their models predict by latent actions
is the same, and is computed once.
"""

from __future__ import annotations

import contextlib
import itertools
import socket
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import torch

from dmotion_bench.errors import DatasetMissing, DmbenchError, JobsLost, RunMismatch
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.execution.refusals import reason
from dmotion_bench.learning.hardware.memory import keep_freed_memory
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.training.shared_pretraining import training_of
from dmotion_bench.planning.mpc import ControlProgress
from dmotion_bench.scoring.control import score_control
from dmotion_bench.scoring.kept_control import share_of
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.score import CONTROL_JOURNAL, is_scored, score_run, scored_data
from dmotion_bench.scoring.settings import Metric, ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.storage.lock import in_turn
from dmotion_bench.wording import shown

_SHARED: Final = SharedSamples()
"""Of the present process: a worker computes once what the runs that it scores have in common."""


@dataclass(frozen=True, kw_only=True)
class ScoreJob:
    """A run to be scored, or some of its control tasks.

    Attributes:
        run: Its folder.
        metrics, settings, renew, data: As ``score_run`` takes them.
        batch_size, device: Of the computation.
        tasks: Numbers of control tasks; None: the whole run.
        progress: The file in which it says how far it is; None: nowhere.
        machine: The name of the one where the command runs.
    """

    run: Path
    metrics: tuple[Metric, ...] | None
    settings: ScoreSettings
    renew: bool
    data: Path | None
    batch_size: int
    device: str
    tasks: tuple[int, ...] | None = None
    progress: Path | None = None
    machine: str = field(default_factory=socket.gethostname)


@dataclass(frozen=True, kw_only=True)
class ScoreOutcome:
    """How the scoring of a run ended.

    Attributes:
        run: Its folder.
        error: Why it failed, in a sentence; None if it did not.
        unfit: Whether that is because the run does not fit the data set that was named.
    """

    run: Path
    error: str | None = None
    unfit: bool = False


def score_job(job: ScoreJob) -> ScoreOutcome:
    """Do a job in the present process; what goes wrong is told, since it concerns one run alone."""
    told = ProgressFile(job.progress)

    def show(what: str, done: int, total: int) -> None:
        told.tell(JobProgress(what=job.run.name, done=done, total=total, status=what))

    how = Execution(batch_size=job.batch_size, device=torch.device(job.device), progress=show)
    try:
        if job.tasks is not None:
            _control_share(job, how)
        else:
            score_run(
                job.run,
                metrics=job.metrics,
                settings=job.settings,
                how=how,
                shared=_SHARED,
                renew=job.renew,
                data=job.data,
            )
    except Exception as error:  # a stranger's model may raise anything; the others are to be scored
        text = reason(error)
        if isinstance(error, DatasetMissing) and (here := socket.gethostname()) != job.machine:
            text = (
                f"on the machine {shown(here)}: {text.rstrip('.')}. All machines must see the workspace and its data "
                "under the same path."
            )
        return ScoreOutcome(run=job.run, error=text, unfit=isinstance(error, RunMismatch))
    finally:
        told.end()
    return ScoreOutcome(run=job.run)


def settled_already(job: ScoreJob) -> ScoreOutcome | None:
    """The outcome of a run's job that would compute nothing; None if somebody has to do it."""
    try:
        if not job.renew and is_scored(job.run, job.metrics, job.settings, job.data):
            return ScoreOutcome(run=job.run)
    except RunMismatch as error:
        return ScoreOutcome(run=job.run, error=str(error), unfit=True)
    except Exception:  # of a stranger's model, too: the job meets it again and says it
        return None
    return None


def score_in_turn(jobs: Sequence[ScoreJob]) -> list[ScoreOutcome]:
    """Do some jobs in the present process, one after the other."""
    return [score_job(job) for job in jobs]


def _by_training(jobs: Sequence[ScoreJob]) -> list[tuple[ScoreJob, ...]]:
    """The jobs of runs that share a training, together; each other job alone."""
    groups: dict[str, list[ScoreJob]] = {}
    for number, job in enumerate(jobs):
        shared = None
        if job.metrics is None or "prediction" in job.metrics:
            with contextlib.suppress(DmbenchError):  # said when the run is scored
                shared = training_of(Run.open(job.run))
        groups.setdefault(shared or f"alone {number}", []).append(job)
    return [tuple(group) for group in groups.values()]


def _control_share(job: ScoreJob, how: Execution) -> None:
    """Work on some control tasks of a run, and leave what was done where the run's own job finds it."""
    keep_freed_memory()
    run, tasks = Run.open(job.run), job.tasks or ()
    data, folder = scored_data(run, job.settings.split, job.data, job.settings.control.column)
    folder.mkdir(parents=True, exist_ok=True)
    journal, share = folder / CONTROL_JOURNAL, share_of(folder / CONTROL_JOURNAL, tasks[0])

    def show(progress: ControlProgress) -> None:
        how.progress(f"control, tasks {tasks[0]} to {tasks[-1]}", progress.steps, progress.total)

    with in_turn(share), using_threads(run.threads):  # another command finds it done
        score_control(
            run.model,
            data,
            job.settings.control,
            device=how.device,
            progress=show,
            checkpoint=share,
            begun=journal,
            numbers=tasks,
        )


def control_shares(job: ScoreJob) -> Iterator[ScoreJob]:
    """The groups of control tasks of a run as jobs of their own; none where control is not asked for or impossible."""
    if job.settings.control.column is None and (job.metrics is None or "control" not in job.metrics):
        return
    with contextlib.suppress(DmbenchError):  # said when the run is scored
        if not job.renew and is_scored(job.run, ("control",), job.settings, job.data):
            return
        data, _ = scored_data(Run.open(job.run), job.settings.split, job.data, job.settings.control.column)
        for numbers in job.settings.control.groups(len(data.tasks())):
            yield ScoreJob(**{**vars(job), "tasks": numbers})


def score_side_by_side(
    jobs: Sequence[ScoreJob], executor: Executor, *, progress: Path | None = None
) -> Generator[ScoreOutcome]:
    """Score runs beside each other; the outcomes come as they are ready.

    Args:
        jobs: One for each run.
        executor: Runs them; all its machines see the runs and data sets under the same paths.
        progress: A folder in which the jobs say how far they are (``job_progress.watching``); None: nowhere.
    """

    def told(many: Sequence[ScoreJob], kind: str) -> list[ScoreJob]:
        places = (None if progress is None else progress / f"{kind}-{number}.json" for number in range(len(many)))
        return [ScoreJob(**{**vars(job), "progress": place}) for job, place in zip(many, places, strict=True)]

    shares = [share for job in jobs for share in control_shares(job)]
    planned = executor.map_unordered(score_job, told(shares, "control"))
    with contextlib.closing(planned), contextlib.suppress(JobsLost):
        for _ in planned:  # what failed fails again, and is said, when the run is scored
            pass
    scored = executor.map_unordered(score_in_turn, _by_training(told(jobs, "run")))
    with contextlib.closing(scored):
        try:
            for outcomes in scored:
                yield from outcomes
        except JobsLost as lost:
            for job in itertools.chain.from_iterable(lost.jobs):
                yield ScoreOutcome(run=job.run, error=str(lost))
