"""``dmbench score``: figures of trained runs on held-out episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.cli.cache import CacheFolder, use_cache

if TYPE_CHECKING:
    from dmotion_bench.scoring.control import ControlScoring
    from dmotion_bench.scoring.report import Report
    from dmotion_bench.scoring.score import Metric

METRICS: tuple[Metric, ...] = ("prediction", "rollout", "control")
REFERENCES = ("idle", "random", "oracle", "scripted")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(score)


def score(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RUN",
            help="Runs; the only one of the workspace if left out. For control also idle, random, oracle, scripted.",
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Every run; reports that are up to date are kept.")] = False,
    metrics: Annotated[
        str, typer.Option(help="Groups of figures, with commas between: prediction, rollout, control.")
    ] = "prediction,rollout",
    split: Annotated[str, typer.Option(help="The episodes to score on: test or validation.")] = "test",
    horizon: Annotated[int, typer.Option(min=1, help="Steps of a rollout.")] = 15,
    tasks: Annotated[int | None, typer.Option(min=1, help="Control: only so many tasks, the first.")] = None,
    planner: Annotated[str | None, typer.Option(help="Control: a wrong name lists them all.")] = None,
    cost: Annotated[
        str | None,
        typer.Option(
            help="Control: followed, tracked, position (the paper's), pixel or feature; what suits model and picture."
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Another data set of the same environment to score on, such as one recorded with '--ranges shifted'; "
            "the run's own if left out. Of a reference: the data set."
        ),
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Triplets predicted at once; changes no figure.")] = 64,
    precision: Annotated[
        str, typer.Option(help="float32, or bf16: faster where the hardware has it, and the report says so.")
    ] = "float32",
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    cache: CacheFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Score runs on the held-out episodes of their data sets, or of another one."""
    from dmotion_bench.errors import UnknownName, UsageError
    from dmotion_bench.workspace import Workspace

    for kind, given, allowed in (
        ("split", split, ("test", "validation")),
        ("precision", precision, ("float32", "bf16")),
        ("device", device, ("auto", "cpu", "cuda")),
    ):
        if given not in allowed:
            raise UnknownName(kind, given, allowed)
    use_cache(cache)
    asked = _metrics(metrics)
    workspace = Workspace.current()
    if runs and (named := [run for run in runs if str(run) in REFERENCES and not run.exists()]):
        if len(named) < len(runs) or every:
            raise UsageError("references are scored for themselves; name no runs beside them.")
        if asked != ("control",):
            raise UsageError(f"{named[0]} is a reference for control; score it with '--metrics control'.")
        _references(
            [str(one) for one in named], workspace.dataset(data), _control(tasks, planner, cost), as_json=as_json
        )
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
        control=_control(tasks, planner, cost),
    )
    other = None if data is None else workspace.dataset(data)
    reports, failures = score_runs(paths, asked, settings, batch_size=batch_size, device=device, keep=every, data=other)
    if as_json:
        summaries = [report.summary() | {"run": str(path)} for path, report in reports.items()]
        typer.echo(json.dumps({"reports": summaries}))
    else:
        _show(reports, overview=every or len(paths) > 1)
    if failures:
        raise _failed(failures, len(paths))


def score_runs(
    paths: list[Path],
    metrics: tuple[Metric, ...],
    settings: Any,
    *,
    batch_size: int = 64,
    device: str = "auto",
    keep: bool = False,
    data: Path | None = None,
) -> tuple[dict[Path, Report], dict[str, str]]:
    """Score runs one after the other, with a progress bar; one that fails does not stop the rest.

    Args:
        keep: Whether reports that are up to date are left as they are.
        data: What to score on in place of each run's own data set; of many, runs that do not fit it are left out.

    Returns:
        The report of each run, and by its name what went wrong with each that has none.
    """
    import torch

    from dmotion_bench.cli.progress import note, progress_bar
    from dmotion_bench.errors import DmbenchError, RunMismatch, UsageError
    from dmotion_bench.learning.run import Run
    from dmotion_bench.scoring.prediction import Execution
    from dmotion_bench.scoring.score import ReferenceScores, score_run

    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("no CUDA device is here; leave --device away to score on the CPU.")
    where = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
    references = ReferenceScores()
    reports: dict[Path, Report] = {}
    failures: dict[str, str] = {}
    with progress_bar() as bar:
        task = bar.add_task("scoring", total=None, status="")
        for path in paths:

            def show(what: str, done: int, total: int, name: str = path.name) -> None:
                bar.update(task, description=f"scoring {name}", completed=done, total=total, status=what)

            try:
                Run.open(path).require_aligned()
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


def _metrics(text: str) -> tuple[Metric, ...]:
    from dmotion_bench.errors import UnknownName, UsageError

    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        if name not in METRICS:
            raise UnknownName("group of figures", name, METRICS)
    if not asked:
        raise UsageError(f"--metrics names no group of figures; known: {', '.join(METRICS)}.")
    return tuple(name for name in METRICS if name in asked)


def _control(tasks: int | None, planner: str | None, cost: str | None) -> ControlScoring:
    from dmotion_bench.planning.planner import DEFAULT_PLANNER
    from dmotion_bench.scoring.control import ControlScoring

    return ControlScoring(tasks=tasks, planner=planner or DEFAULT_PLANNER, cost=cost)


def _references(names: list[str], path: Path, scoring: ControlScoring, *, as_json: bool) -> None:
    """Score references for control; what they did stays in the data set's cache."""
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.cli.report_table import show_control
    from dmotion_bench.planning.control import ControlProgress
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
