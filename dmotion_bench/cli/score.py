"""``dmbench score``: figures of trained runs on held-out episodes."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from dmotion_bench.api.settings import DEVICES, require_one_of
from dmotion_bench.cli.cache import CacheFolder, use_cache
from dmotion_bench.cli.jobs import ExecutorName, Workers, jobs_folder, require_all
from dmotion_bench.cli.options import (
    METRICS,
    REFERENCES,
    AsJson,
    Device,
    ObjectiveName,
    ObjectiveSettings,
    PlannerName,
    PlannerSettings,
    listed,
)

if TYPE_CHECKING:
    from dmotion_bench.scoring.control import ControlScoring
    from dmotion_bench.scoring.report import Report
    from dmotion_bench.scoring.score import Metric
    from dmotion_bench.workspace import Workspace

_GIGABYTES: Final = 2.0  # that scoring takes beside others
_CLUSTER_GIGABYTES: Final = 16
_CLUSTER_MINUTES: Final = 24 * 60


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(score)


def score(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RUN",
            help="Runs to score, by path or name. Default: the only run of the workspace. For control "
            "also a reference to compare with: idle, random, oracle or scripted.",
        ),
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Score every run. Reports that are up to date are kept.")
    ] = False,
    metrics: Annotated[
        str | None,
        typer.Option(
            metavar=f"{listed(METRICS)},...",
            help="Groups of figures to compute, separated by commas. prediction: single steps; rollout: predictions "
            "that continue from their own predictions; gain: what the actions that the model prefers truly bring, a "
            "minute, and a few more for a data set's first run; control: planning in the simulator, which takes "
            "minutes. Default: all but control.",
        ),
    ] = None,
    split: Annotated[
        str, typer.Option(metavar=listed(("test", "validation")), help="Which held-out episodes to score on.")
    ] = "test",
    horizon: Annotated[int, typer.Option(min=1, help="Number of steps in a rollout.")] = 15,
    tasks: Annotated[
        int | None,
        typer.Option(min=1, help="For control: work on the data set's first tasks only, this many. Default: all."),
    ] = None,
    planner: PlannerName = None,
    planner_set: PlannerSettings = None,
    objective: ObjectiveName = None,
    objective_set: ObjectiveSettings = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Data set to score on: another one of the same environment, such as one recorded with '--ranges "
            "shifted', or an import whose actions have the same names. Default: the data set that the run was trained "
            "on. A reference needs a data set, too."
        ),
    ] = None,
    batch_size: Annotated[
        int,
        typer.Option(min=1, help="Number of predictions computed at once. The figures are the same for any number."),
    ] = 64,
    precision: Annotated[
        str,
        typer.Option(
            metavar=listed(("float32", "bf16")),
            help="Number format of the model's arithmetic. bf16 is faster on some hardware, and the report says so.",
        ),
    ] = "float32",
    device: Device = "auto",
    workers: Workers = None,
    executor: ExecutorName = None,
    cache: CacheFolder = None,
    as_json: AsJson = False,
) -> None:
    """Compute the figures of runs on test episodes, of their own data set or of another one."""
    from dmotion_bench.errors import UsageError
    from dmotion_bench.workspace import Workspace

    require_one_of("split", split, ("test", "validation"))
    require_one_of("precision", precision, ("float32", "bf16"))
    require_one_of("device", device, DEVICES)
    use_cache(cache)
    asked = None if metrics is None else _metrics(metrics)
    control = _control(tasks, planner, planner_set, objective, objective_set)
    workspace = Workspace.current()
    if runs and (named := [run for run in runs if str(run) in REFERENCES and not run.exists()]):
        if len(named) < len(runs) or every:
            raise UsageError(
                "runs and references cannot be scored by the same command; name only references, or only runs."
            )
        if asked != ("control",):
            raise UsageError(f"{named[0]} is a reference for control; score it with '--metrics control'.")
        _references([str(one) for one in named], workspace.dataset(data), control, as_json=as_json)
        return
    if every and runs:
        raise UsageError("--all scores every run; name runs or give --all, not both.")
    paths = workspace.all_runs() if every else [workspace.run(run) for run in runs or []]
    if not paths:
        paths = [workspace.run(None)]

    from dmotion_bench.scoring.score import ScoreSettings

    settings = ScoreSettings(
        split="validation" if split == "validation" else "test",
        horizon=horizon,
        precision="bf16" if precision == "bf16" else "float32",
        control=control,
    )
    other = None if data is None else workspace.dataset(data)
    if not every:
        require_all("score", workers, executor)
    many = workers or _scored_at_once(device, executor, len(paths)) if every else 1
    if executor in (None, "local") and many == 1:
        reports, failures = score_runs(
            paths, asked, settings, batch_size=batch_size, device=device, keep=every, data=other
        )
    else:
        reports, failures = _beside_each_other(
            paths,
            asked,
            settings,
            workspace,
            executor or "local",
            many,
            batch_size=batch_size,
            device=device,
            data=other,
        )
    if as_json:
        summaries = [report.summary() | {"run": str(path)} for path, report in reports.items()]
        typer.echo(json.dumps({"reports": summaries}))
    else:
        _show(reports, overview=every or len(paths) > 1)
    if failures:
        raise _failed(failures, len(paths))


def score_runs(
    paths: list[Path],
    metrics: tuple[Metric, ...] | None,
    settings: Any,
    *,
    batch_size: int = 64,
    device: str = "auto",
    keep: bool = False,
    data: Path | None = None,
) -> tuple[dict[Path, Report], dict[str, str]]:
    """Score runs one after the other, with a progress bar; one that fails does not stop the rest.

    Args:
        metrics: Which groups of figures; None for all but control that a data set can have.
        keep: Whether reports that are up to date are left as they are.
        data: What to score on in place of each run's own data set; of many, runs that do not fit it are left out.

    Returns:
        The report of each run, and by its name what went wrong with each that has none.
    """
    import torch

    from dmotion_bench.cli.progress import note, progress_bar
    from dmotion_bench.errors import DmbenchError, RunMismatch, UsageError
    from dmotion_bench.execution.local_executor import available_workers
    from dmotion_bench.learning.run import Run
    from dmotion_bench.learning.threads import scoring_shortage
    from dmotion_bench.scoring.prediction import Execution
    from dmotion_bench.scoring.score import ReferenceScores, score_run

    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("this machine has no CUDA device; leave out --device to score on the CPU.")
    where = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
    references = ReferenceScores()
    reports: dict[Path, Report] = {}
    failures: dict[str, str] = {}
    warned: set[str] = set()
    with progress_bar() as bar:
        task = bar.add_task("scoring", total=None, status="")
        for path in paths:

            def show(what: str, done: int, total: int, name: str = path.name) -> None:
                bar.update(task, description=f"scoring {name}", completed=done, total=total, status=what)

            try:
                told = scoring_shortage(Run.open(path).threads or 1, available_workers())
                if told is not None and told not in warned:
                    warned.add(told)
                    note(told)
                reports[path] = score_run(
                    path,
                    metrics=metrics,
                    settings=settings,
                    how=Execution(batch_size=batch_size, device=where, progress=show),
                    references=references,
                    renew=not keep,
                    data=data,
                )
            except Exception as error:
                if len(paths) == 1:
                    raise
                if keep and data is not None and isinstance(error, RunMismatch):
                    typer.echo(f"left out: {error}", err=True)
                    continue
                failures[path.name] = str(error) if isinstance(error, DmbenchError) else repr(error)
                note(f"{path.name}: {failures[path.name]}")
    return reports, failures


def _scored_at_once(device: str, executor: str | None, runs: int) -> int | None:
    """How many runs are scored beside each other: as many as there are processors and memory for."""
    import torch

    from dmotion_bench.execution.local_executor import available_workers

    if executor not in (None, "local"):
        return None
    if device == "cuda" or (device == "auto" and torch.cuda.is_available()):
        return 1
    return min(available_workers(_GIGABYTES), runs)


def _beside_each_other(
    paths: list[Path],
    metrics: tuple[Metric, ...] | None,
    settings: Any,
    workspace: Workspace,
    executor: str,
    workers: int | None,
    *,
    batch_size: int,
    device: str,
    data: Path | None,
) -> tuple[dict[Path, Report], dict[str, str]]:
    """Score runs by an executor, and show how far all of its jobs are; reports that are up to date are kept."""
    import torch

    from dmotion_bench.cli.progress import note, progress_bar
    from dmotion_bench.errors import UsageError
    from dmotion_bench.execution.executor import JobSize
    from dmotion_bench.execution.executors import make_executor
    from dmotion_bench.execution.job_progress import watching
    from dmotion_bench.scoring.score import scored_report
    from dmotion_bench.scoring.side_by_side import ScoreJob, score_side_by_side

    if device == "cuda" and executor == "local" and not torch.cuda.is_available():
        raise UsageError("this machine has no CUDA device; leave out --device to score on the CPU.")
    where = "cuda" if device == "cuda" or (device == "auto" and torch.cuda.is_available()) else "cpu"
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
    own = {job.run: path for job, path in zip(jobs, paths, strict=True)}
    reports: dict[Path, Report] = {}
    failures: dict[str, str] = {}
    size = JobSize(gigabytes=_CLUSTER_GIGABYTES, minutes=_CLUSTER_MINUTES)
    with jobs_folder(workspace) as folder, progress_bar() as bar:
        hands = make_executor(executor, workers, scratch=folder / executor, size=size)
        task = bar.add_task("scoring", total=len(jobs), status="")
        bar.update(task, completed=0)
        outcomes = score_side_by_side(jobs, hands, progress=folder)
        with watching(folder, lambda running: bar.show_jobs(task, running)), contextlib.closing(outcomes):
            for done, outcome in enumerate(outcomes, start=1):
                bar.update(task, completed=done)
                path = own[outcome.run]
                if outcome.error is None:
                    reports[path] = scored_report(path, settings.split, data)
                elif outcome.unfit and data is not None:
                    typer.echo(f"left out: {outcome.error}", err=True)
                else:
                    failures[path.name] = outcome.error
                    note(f"{path.name}: {outcome.error}")
    return {path: reports[path] for path in paths if path in reports}, failures


def _metrics(text: str) -> tuple[Metric, ...]:
    from dmotion_bench.errors import UsageError

    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        require_one_of("group of figures", name, METRICS)
    if not asked:
        raise UsageError(f"--metrics names no group of figures; known: {', '.join(METRICS)}.")
    return tuple(name for name in METRICS if name in asked)


def _control(
    tasks: int | None,
    planner: str | None,
    planner_set: list[str] | None,
    objective: str | None,
    objective_set: list[str] | None,
) -> ControlScoring:
    from dmotion_bench.planning.choices import DEFAULT_SOLVER
    from dmotion_bench.scoring.control import ControlScoring

    return ControlScoring(
        tasks=tasks,
        planner=planner or DEFAULT_SOLVER,
        planner_set=tuple(planner_set or ()),
        objective=objective,
        objective_set=tuple(objective_set or ()),
    )


def _references(names: list[str], path: Path, scoring: ControlScoring, *, as_json: bool) -> None:
    """Score references for control; what they did stays in the data set's cache."""
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.cli.report_table import show_control
    from dmotion_bench.planning.mpc import ControlProgress
    from dmotion_bench.scoring.control import control_samples, score_reference
    from dmotion_bench.scoring.figures import figures_of
    from dmotion_bench.storage.dataset import Dataset

    dataset, figures = Dataset.open(path), {}
    with progress_bar() as bar:
        for name in names:
            row = bar.add_task(f"control by {name}", total=None, status="")

            def show(progress: ControlProgress, row: Any = row) -> None:
                bar.update(row, completed=progress.steps, total=progress.total)

            result = score_reference(name, dataset, scoring, progress=show)
            found = figures_of(control_samples(name, result), name)
            figures[name] = {figure: estimate.to_json() for figure, estimate in found.items()}
    if as_json:
        plain: dict[str, Any] = {
            "arch": None,
            "dataset": dataset.name,
            "labels": None,
            "seed": scoring.seed,
            "reference": {},
        }
        reports = [{"run": name, "model": name, **plain, "figures": figures[name]} for name in names]
        typer.echo(json.dumps({"reports": reports}))
    else:
        show_control(figures, f"control on {dataset.name}")


def _show(reports: dict[Path, Report], *, overview: bool) -> None:
    from dmotion_bench.cli.report_table import show_overview, show_report

    if overview:
        show_overview(reports)
    else:
        for path, report in reports.items():
            show_report(report, path)


def _failed(failures: dict[str, str], total: int) -> Exception:
    from dmotion_bench.errors import RunError

    listed = "\n".join(f"  {name}: {error}" for name, error in failures.items())
    return RunError(f"{len(failures)} of {total} runs could not be scored:\n{listed}")
