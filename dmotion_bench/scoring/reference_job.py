"""Control by a reference as a job of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dmotion_bench.errors import DmbenchError
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.planning.mpc import ControlProgress
from dmotion_bench.scoring.control import ControlScoring, score_reference
from dmotion_bench.storage.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class ReferenceJob:
    """Control by a reference, as plain values.

    Attributes:
        name: Of the reference.
        data: The data set's folder, in whose cache stays what it did.
        scoring: Which tasks, and how.
        progress: The file in which it says how far it is.
    """

    name: str
    data: Path
    scoring: ControlScoring
    progress: Path | None


def score_reference_job(job: ReferenceJob) -> tuple[Path, str | None]:
    """Do a job in the present process; the data set's folder, and why it failed, if it did."""
    told = ProgressFile(job.progress)

    def show(progress: ControlProgress) -> None:
        told.tell(JobProgress(what=f"control by {job.name}", done=progress.steps, total=progress.total))

    try:
        score_reference(job.name, Dataset.open(job.data), job.scoring, progress=show)
    except DmbenchError as error:
        return job.data, str(error)
    finally:
        told.end()
    return job.data, None
