"""Looking through recordings before they are imported, several at a time, by an executor.

A job looks through one large recording, or several small ones: a reader of recordings takes long to start. A damaged
recording does not harm those after it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.importing import Progress
from dmotion_bench.storage.imports.limits import MIB
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Survey
from dmotion_bench.storage.imports.sources import Source, open_recording

MOST_TOGETHER: Final = 16
BYTES_TOGETHER: Final = 64 * MIB
"""Recordings that one job looks through, and their bytes: a reader takes a quarter of a second to start."""


@dataclass(frozen=True, kw_only=True)
class SurveyJob:
    """Recordings to be looked through.

    Attributes:
        sources: Where they are, by their places among those that were named.
        options: Of the import.
        progress: The file in which the job says how far it is; None: nowhere.
    """

    sources: dict[int, Source]
    options: ImportOptions
    progress: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Surveyed:
    """What was found in a recording.

    Attributes:
        number, source: Its place, and where it is.
        digest: SHA-256 of its bytes; empty for a damaged one.
        survey: None for a damaged one.
        unreadable: Pictures that could not be read.
        fault: Why it cannot be imported; None for a sound one.
    """

    number: int
    source: Source
    digest: str = ""
    survey: Survey | None = None
    unreadable: int = 0
    fault: RecordingImportError | None = None

    @property
    def path(self) -> Path:
        """Of the recording."""
        return self.source.path

    def sha256(self) -> str:
        """Of its bytes, in hexadecimal."""
        return self.digest


def survey_job(job: SurveyJob) -> tuple[Surveyed, ...]:
    """Look through recordings in the present process."""
    told = ProgressFile(job.progress)

    def show(name: str, pictures: int) -> None:
        what = f"looking through {name}"
        told.tell(JobProgress(what=what, done=pictures, total=None, status=f"{pictures:,} pictures"))

    with Confinement(job.options) as confinement:
        try:
            return tuple(_surveyed(number, source, confinement, show) for number, source in job.sources.items())
        finally:
            told.end()


def _surveyed(number: int, source: Source, confinement: Confinement, show: Callable[[str, int], None]) -> Surveyed:
    """What is found in a recording; one that is damaged does not harm those after it."""
    try:
        recording = open_recording(source, confinement.options, confinement)
        survey = recording.survey(lambda pictures: show(source.path.name, pictures))
        digest, unreadable = recording.sha256(), recording.unreadable
    except RecordingImportError as error:
        fault = error
    except OSError as error:
        fault = RecordingImportError(f"cannot read {str(source.path)!r}: {error.strerror or error}.")
    else:
        return Surveyed(number=number, source=source, digest=digest, survey=survey, unreadable=unreadable)
    confinement.close()  # its process may be gone, or in the middle of an answer; the next recording starts another
    return Surveyed(number=number, source=source, fault=fault)


def looked_through(
    sources: Sequence[Source], options: ImportOptions, executor: Executor, progress: Progress, jobs: Path | None
) -> list[Surveyed]:
    """What is in the recordings, in their order.

    Args:
        sources: Where they are.
        options: Of the import.
        executor: Runs the jobs.
        progress: Is told how many have been looked through.
        jobs: A folder in which the jobs say how far they are; None: nowhere.
    """
    asked = [
        SurveyJob(sources=part, options=options, progress=None if jobs is None else jobs / f"survey-{number}.json")
        for number, part in enumerate(_parts_of_sources(sources))
    ]
    done: dict[int, Surveyed] = {}
    progress("looking through the recordings", 0, len(sources))
    results = executor.map_unordered(survey_job, asked)
    with contextlib.closing(results):
        for found in results:
            done |= {one.number: one for one in found}
            progress("looking through the recordings", len(done), len(sources))
    return [done[number] for number in range(len(sources))]


def _parts_of_sources(sources: Sequence[Source]) -> list[dict[int, Source]]:
    """Recordings that are looked through together: small ones in company, large ones and folders alone."""
    parts, room = list[dict[int, Source]](), 0
    for number, source in enumerate(sources):
        size = _size(source)
        if not parts or len(parts[-1]) == MOST_TOGETHER or size > room:
            parts.append({})
            room = BYTES_TOGETHER
        parts[-1][number] = source
        room -= size
    return parts


def _size(source: Source) -> int:
    """In bytes; more than any part may have for what is no file."""
    try:
        return source.path.stat().st_size if source.path.is_file() else BYTES_TOGETHER + 1
    except OSError:
        return 0  # whoever opens it says why it cannot be read
