"""Control by a reference as jobs: one for each group of tasks.

A job keeps what it did in a journal of its own in the data set's cache. Whoever asks for the reference next takes these
over (``reference_control.score_reference``), so the results are those of one process.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dmotion_bench.errors import DmbenchError
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.planning.mpc import ControlProgress
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.reference_control import score_share_of_reference
from dmotion_bench.storage.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class ReferenceJob:
    """Control by a reference, as plain values.

    Attributes:
        name: Of the reference.
        data: The data set's folder, in whose cache stays what it did.
        scoring: Which tasks, and how.
        tasks: The numbers of those that are this job's, a whole group.
        progress: The file in which it says how far it is; None: nowhere.
    """

    name: str
    data: Path
    scoring: ControlScoring
    tasks: tuple[int, ...]
    progress: Path | None = None


def reference_jobs(name: str, dataset: Dataset, scoring: ControlScoring) -> list[ReferenceJob]:
    """All of a reference's work on a data set, whether it is done or not; arguments as of ``score_reference``."""
    groups = scoring.groups(len(dataset.tasks()))
    data = dataset.path.absolute()
    return [ReferenceJob(name=name, data=data, scoring=scoring, tasks=group) for group in groups]


def score_reference_job(job: ReferenceJob) -> tuple[Path, DmbenchError | None]:
    """Do a job in the present process; the data set's folder, and why it failed, if it did."""
    told, what = ProgressFile(job.progress), f"control by {job.name}, tasks {job.tasks[0]} to {job.tasks[-1]}"

    def show(progress: ControlProgress) -> None:
        told.tell(JobProgress(what=what, done=progress.steps, total=progress.total))

    try:
        score_share_of_reference(job.name, Dataset.open(job.data), job.scoring, job.tasks, progress=show)
    except DmbenchError as error:
        return job.data, error
    finally:
        told.end()
    return job.data, None
