"""A whole table of figures: record its worlds, train its models, score their runs, build its pages."""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dmotion_bench.api.contract import begins_all_the_same, breaches_before, train_rows_explained, with_breach
from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.recording import executor_for, record_recipe
from dmotion_bench.api.scoring import compute_device
from dmotion_bench.api.settings import DEVICES, EXECUTORS, as_preset, require_one_of, whole
from dmotion_bench.api.side_by_side import THREADS, Hands, score_at_once
from dmotion_bench.errors import JobsLost, ModelContractBroken, UsageError
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress, jobs_folder, watching
from dmotion_bench.learning.training.table import Outcome, TableJob, train_jobs
from dmotion_bench.registry import leaderboard_part
from dmotion_bench.registry import table as table_named
from dmotion_bench.reproduction.cost import Cost, control_places, cost_of
from dmotion_bench.reproduction.plan import Plan, Training, require_models
from dmotion_bench.reproduction.settled import INDEX, Page, has_figures, is_of, state_of
from dmotion_bench.reproduction.speeds import Speeds
from dmotion_bench.reproduction.table import Column, Table
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.reference_job import ReferenceJob, score_reference_job
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, Workspace, as_path, in_workspace

_LOG = logging.getLogger(__name__)


def _nobody(*_: object) -> None:
    """Nobody wants to know."""


@dataclass(frozen=True, kw_only=True)
class Watch:
    """Who is told how far a table is.

    Attributes:
        count: Told of each part how much of how much is done.
        jobs: Told how far those jobs are that run, by their names.
        note: Told in a sentence what failed.
    """

    count: Callable[[str, int, int], None] = field(default=_nobody)
    jobs: Callable[[Mapping[str, JobProgress]], None] = field(default=_nobody)
    note: Callable[[str], None] = field(default=_LOG.info)


@dataclass(frozen=True, kw_only=True)
class Reproduced:
    """What became of a table.

    Attributes:
        table: Its name.
        cost: What was left of it before the work began.
        pages: Its pages, those that were there already, too; empty after a dry run.
        runs: The folders of its runs.
        failures: Why a training, a scoring or a page failed, by what it was.
    """

    table: str
    cost: Cost
    pages: tuple[Path, ...] = ()
    runs: tuple[Path, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench reproduce --json`` prints."""
        return {
            "table": self.table,
            "left": self.cost.to_json(),
            "pages": list(map(str, self.pages)),
            "runs": list(map(str, self.runs)),
            "failures": dict(self.failures),
        }


@in_workspace
def reproduce(
    table: str | Table,
    *,
    preset: Preset | str | None = None,
    seeds: Sequence[int] | None = None,
    models: Sequence[str] | None = None,
    worlds: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    executor: str = "local",
    workers: int | None = None,
    device: str = "auto",
    speeds: AnyPath | None = None,
    dry_run: bool = False,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Reproduced:
    """Record, train, score and build the pages of a table. The same call goes on with one that was interrupted.

    What is done already is left as it is. Trainings compute with one thread each, so that the weights are the same for
    any number of workers.

    Args:
        table: A registered name (``"paper"``, ``"control"``, ``"continuous"``, ``"labels"``, ``"laom"``), or a table
            of your own.
        preset: Size of recordings and trainings; the table's by default.
        seeds, models, worlds, columns: A part of the table.
        executor: Where jobs run: ``"local"``, ``"ray"`` or ``"slurm"``.
        workers: Jobs at a time; by default as many as there are processors and memory for, also on a GPU, which they
            share. More than one need ``if __name__ == "__main__":`` in a script.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        speeds: A file that ``dmbench bench --json`` wrote; the cost is computed from it where it has the speeds.
        dry_run: Whether to say only what is left and what it costs.
        workspace: The folder with ``data/``, ``runs/`` and ``reports/``; the current one by default.
        progress: A function that is told how far each part is, or True for a bar.

    Raises:
        UnknownName, UsageError: A name or a value that is not allowed.
        RecipeMismatch: The folder of a data set holds another one.
        RunMismatch: The folder of a run holds one of other settings or other data.

    Example:
        >>> told = dm.reproduce("labels", preset="tiny", models=["lapo"], worlds=["planar_push"], dry_run=True)
        >>> told.cost.jobs("record"), told.cost.jobs("train")
        (1, 3)
    """
    require_one_of("executor", executor, EXECUTORS)
    part = {"models": models, "worlds": worlds, "columns": columns}
    plan = plan_table(table, preset=preset, seeds=seeds, **part, workspace=workspace)
    with telling(progress) as tell:

        def count(part: str, done: int, total: int) -> None:
            tell(JobProgress(what=part, done=done, total=total))

        hands = Hands(executor=executor, workers=whole("workers", workers, 1), device=device)
        cost = what_it_costs(plan, hands, speeds, lambda what: count(f"measuring {what}", 0, 1))
        if dry_run:
            return Reproduced(table=plan.name, cost=cost)
        return make(plan, cost, hands, Watch(count=count))


@in_workspace
def plan_table(
    table: str | Table,
    *,
    preset: Preset | str | None = None,
    seeds: Sequence[int] | None = None,
    models: Sequence[str] | None = None,
    worlds: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    workspace: AnyPath | None = None,
) -> Plan:
    """The jobs of a table, or of a part of it.

    Raises:
        UnknownName, UsageError: A name that is not registered or not in the table, or nothing is left of it.
        RecipeMismatch: The folder of a data set holds another one.
        RunMismatch: The folder of a run holds one of other settings or other data.
    """
    if not isinstance(table, str | Table):
        raise UsageError(f"{shown(table)} is no table; give a table's name, such as 'paper', or a Table.")
    name, known = (table, table_named(table)) if isinstance(table, str) else ("own", table)
    size = None if preset is None else as_preset(preset)
    part = known.narrowed(preset=size, seeds=seeds, models=models, worlds=worlds, columns=columns)
    require_models(part)
    (plan := Plan(part, name, Workspace.current())).require_own()
    return plan


def what_it_costs(
    plan: Plan, hands: Hands, speeds: AnyPath | None = None, announce: Callable[[str], None] = _nobody
) -> Cost:
    """What is left of a table, and what that costs on this machine, also where a cluster is to do it.

    Args:
        plan: The table.
        hands: Who is to do the jobs, and on which device.
        speeds: A file with speeds; those that it lacks are measured.
        announce: Told what is measured.

    Raises:
        UsageError: This machine is to do the jobs and lacks the device, or the file holds no speeds.
    """
    require_one_of("device", hands.device, DEVICES)
    device = compute_device("auto" if hands.on_cluster and hands.device == "cuda" else hands.device)
    stored = None if speeds is None else as_path("file of speeds", speeds)
    return cost_of(plan, Speeds(device=device, announce=announce, stored=stored))


def make(plan: Plan, cost: Cost, hands: Hands, watch: Watch | None = None) -> Reproduced:
    """Do what is left of a table.

    Args:
        plan: The table.
        cost: What was left of it; returned as it is.
        hands: Who does the jobs; of it ``count`` and ``watch`` are not used.
        watch: Who is told how far it is.
    """
    work = _Work(plan, hands, watch or Watch())
    work.record()
    plan.require_own()  # runs may have learnt from data that were recorded anew
    work.train()
    for columns in plan.pages():
        for column in columns:
            work.score(column)
        work.build(columns)
    runs = dict.fromkeys(path for training in plan.trainings for path in training.runs(plan.workspace))
    return Reproduced(
        table=plan.name,
        cost=cost,
        pages=tuple(work.pages),
        runs=tuple(path for path in runs if path.is_dir()),
        failures=work.failures,
    )


class _Work:
    """The parts of a table, one after the other; each does what is left.

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
        with self._executing(len(places)) as (executor, folder):
            jobs = [
                ReferenceJob(name=name, data=data.absolute(), scoring=scoring, progress=folder / f"{number}.json")
                for number, (data, scoring) in enumerate(places)
            ]
            self.watch.count(part, 0, len(jobs))
            results = executor.map_unordered(score_reference_job, jobs)
            with watching(folder, self.watch.jobs), contextlib.closing(results):
                try:
                    for done, (data, failure) in enumerate(results, start=1):
                        self.watch.count(part, done, len(jobs))
                        if failure:
                            self._note_failure(part, failure)
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
