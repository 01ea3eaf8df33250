"""The work of a table: its parts, from recordings to pages, each of which does what is left."""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from dmotion_bench.api.contract import begins_all_the_same, breaches_before, train_rows_explained, with_breach
from dmotion_bench.api.recording import executor_for, record_recipe
from dmotion_bench.api.side_by_side import THREADS, Hands, score_at_once
from dmotion_bench.errors import JobsLost, ModelContractBroken
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress, jobs_folder, watching
from dmotion_bench.learning.training.table import Outcome, TableJob, train_jobs
from dmotion_bench.registry import leaderboard_part
from dmotion_bench.reproduction.cost import control_places
from dmotion_bench.reproduction.plan import Plan, Training
from dmotion_bench.reproduction.settled import INDEX, Page, has_figures, is_of, state_of
from dmotion_bench.reproduction.table import Column
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.reference_job import reference_jobs, score_reference_job
from dmotion_bench.storage.dataset import Dataset

_LOG = logging.getLogger(__name__)


def _nobody(*_: object) -> None:
    """Nobody wants to know."""


@dataclass(frozen=True, kw_only=True)
class Watch:
    """Who is told how far a table is.

    Attributes:
        count: Told of each part how much of how much is done.
        jobs: Told how far those jobs are that run, by their names.
        note: Told in a sentence what failed, and what those who train are warned of.
    """

    count: Callable[[str, int, int], None] = field(default=_nobody)
    jobs: Callable[[Mapping[str, JobProgress]], None] = field(default=_nobody)
    note: Callable[[str], None] = field(default=_LOG.info)


class TableWork:
    """The parts of a table, one after the other; each does what is left.

    Args:
        plan: The table.
        hands: Who does the jobs; of it ``count`` and ``watch`` are not used.
        watch: Who is told how far each part is.

    Attributes:
        failures: Why something failed.
        pages: That were built, or are there.
    """

    def __init__(self, plan: Plan, hands: Hands, watch: Watch) -> None:
        self.plan, self.workspace, self.watch, self.hands = plan, plan.workspace, watch, hands
        self.failures: dict[str, str] = {}
        self.pages: list[Path] = []

    def record(self) -> None:
        """Record every data set that is not there, or not as the table has it."""
        left = [one for one in self.plan.recordings if not one.is_recorded()]
        total, done = sum(one.recipe.episodes for one in left), 0
        name, workers = self.hands.executor or "local", self.hands.workers
        for one in left:

            def tell(told: JobProgress, before: int = done) -> None:
                self.watch.count("recording", before + int(told.done), total)

            record_recipe(one.recipe, one.folder, executor_for(one.recipe, one.folder, name, workers), tell)
            done += one.recipe.episodes
            self.watch.count("recording", done, total)

    def train(self) -> None:
        """Train every run that is not trained; a failing one does not stop the others."""
        left = [one for one in self.plan.trainings if one.left(self.workspace)[0]]
        for folder in dict.fromkeys(one.recording.folder for one in left):
            dataset = Dataset.open(folder)
            if not dataset.cache_file.lacking():
                dataset.cache()  # once, and not by every job
        total = sum(len(one.rows) for one in left)
        if not left:
            return
        breaches = self._breaches(left)
        with self._executing(len(left)) as (executor, folder):
            jobs = [self._job(one, folder / f"{number}.json") for number, one in enumerate(left)]
            outcomes = train_jobs(jobs, executor, train_rows_explained)
            self.watch.count("training", 0, total)
            with watching(folder, self.watch.jobs), contextlib.closing(outcomes):
                for done, outcome in enumerate(outcomes, start=1):
                    self.watch.count("training", done, total)
                    self._note_outcome(with_breach(outcome, breaches))

    def _breaches(self, left: Sequence[Training]) -> Mapping[str, ModelContractBroken]:
        """What models of others break of their contract; each is told before its trainings begin."""
        datasets = {one.recording.folder: Dataset.open(one.recording.folder) for one in left}
        asked = ((row.request(one.request), datasets[one.recording.folder]) for one in left for row in one.rows)
        found = breaches_before(asked, self.workspace)
        for breach in found.values():
            self.watch.note(begins_all_the_same(breach))
        return found

    def score(self, column: Column) -> None:
        """Score the runs of a column that lack figures, except beside a reference that failed: those wait for it."""
        state = state_of(self.plan, column)
        lacking: set[Path] = set()
        for reference in column.references:
            places = control_places(state)
            if places:
                lacking |= self._references(reference, column, [(one.place.folder, one.control) for one in places])
        part = f"scoring {column.name}"
        scorings = self.plan.of_column(column)
        ready = [one for one in scorings if not (one.references and one.place.folder.absolute() in lacking)]
        # what stands without its references is scored again: they are put beside a model when it is scored
        to_score = [
            (one, path, not (one.references and has_figures(path, one)))
            for one, _, path in state.to_score
            if one in ready
        ]
        total, done = len(to_score), 0
        for scoring, keep in itertools.product(ready, (True, False)):
            paths = [path for one, path, kept in to_score if one is scoring and kept is keep]
            if not paths:
                continue

            def count(scored: int, _: int, before: int = done) -> None:
                self.watch.count(part, before + scored, total)

            _, failures = score_at_once(
                paths,
                scoring.metrics(),
                scoring.settings,
                self.workspace,
                replace(self.hands, count=count, watch=self.watch.jobs),
                keep=keep,
                data=scoring.data,
                note=self.watch.note,
            )
            self.failures |= {f"scoring {path.name} for {column.name}": why for path, why in failures.items()}
            done += len(paths)

    def build(self, columns: Sequence[Column]) -> None:
        """Build the page of some columns, if it lacks an entry or is behind. What stands there of other parts stays."""
        states = [state_of(self.plan, column) for column in columns]
        folder = self.plan.page(columns[0])
        new = list(dict.fromkeys(path for state in states for path in state.to_enter))
        page = Page(folder)
        standing = [path for state in states for path in state.standing]
        if new or (standing and page.is_behind()):
            part = f"building {folder.name}"
            runs = {path.name for training in self.plan.trainings for path in training.runs(self.workspace)}
            standing += page.beside(runs, self.plan.table.preset)
            kept = [path for path in dict.fromkeys(standing) if not is_of(path, new)]

            def show(_: str, done: int, total: int) -> None:
                self.watch.count(part, done, total)

            built = leaderboard_part("build")(new, kept, folder, on_progress=show)
            lacking = {path.name for column in columns for path in state_of(self.plan, column).to_enter}
            self.failures |= {f"the entry of {run}": _why_lacking(run, built.left_out) for run in lacking}
        if (index := folder / INDEX).is_file():
            self.pages.append(index)

    def _references(self, name: str, column: Column, places: Sequence[tuple[Path, ControlScoring]]) -> set[Path]:
        """Score a reference on some data sets; the folders of those on which it failed."""
        part = f"control by {name} for {column.name}"
        lacking: set[Path] = set()
        shared = [job for data, scoring in places for job in reference_jobs(name, Dataset.open(data), scoring)]
        with self._executing(len(shared)) as (executor, folder):
            jobs = [replace(job, progress=folder / f"{number}.json") for number, job in enumerate(shared)]
            self.watch.count(part, 0, len(jobs))
            results = executor.map_unordered(score_reference_job, jobs)
            with watching(folder, self.watch.jobs), contextlib.closing(results):
                try:
                    for done, (data, failure) in enumerate(results, start=1):
                        self.watch.count(part, done, len(jobs))
                        if failure is not None and data not in lacking:
                            self._note_failure(part, str(failure))
                            lacking.add(data)
                except JobsLost as lost:
                    self._note_failure(part, str(lost))
                    lacking |= {job.data for job in lost.jobs}
        return lacking

    @contextlib.contextmanager
    def _executing(self, jobs: int) -> Iterator[tuple[Executor, Path]]:
        """An executor for so many jobs, and the folder in which they meet."""
        name = self.hands.executor or "local"
        size = self.hands.job_size(processors=THREADS)
        with jobs_folder(self.workspace) as folder:
            yield make_executor(name, self.hands.at_once(jobs), scratch=folder / name, size=size), folder

    def _job(self, training: Training, progress: Path) -> TableJob:
        return TableJob(
            request=training.request,
            rows=training.rows,
            dataset=training.recording.folder.absolute(),
            workspace=self.workspace.root.absolute(),
            device=self.hands.job_device,
            threads=THREADS,
            progress=progress,
        )

    def _note_outcome(self, outcome: Outcome) -> None:
        for told in outcome.warnings:
            self.watch.note(told)
        if outcome.error is not None:
            run = "" if outcome.run is None else f", {outcome.run.name}"
            self._note_failure(f"training {outcome.row.model} with {outcome.row.labels}{run}", outcome.error)

    def _note_failure(self, what: str, why: str) -> None:
        """Keep why something failed; what is called the same fails for itself, such as a model in another world."""
        names = itertools.chain([what], (f"{what} ({number})" for number in itertools.count(2)))
        what = next(name for name in names if name not in self.failures)
        self.failures[what] = why
        self.watch.note(f"{what}: {why}")


def _why_lacking(run: str, left_out: Mapping[str, str]) -> str:
    """What was said of a run, or of it on other data, when its page was built."""
    said = (why for name, why in left_out.items() if name == run or name.startswith(f"{run} on "))
    return next(said, "it is not there")
