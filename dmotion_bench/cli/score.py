"""``dmbench score``: figures of trained runs on held-out episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from dmotion_bench.scoring.report import Report
    from dmotion_bench.scoring.score import Metric

METRICS = ("prediction", "rollout", "control")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(score)


def score(
    runs: Annotated[
        list[Path] | None, typer.Argument(metavar="RUN", help="Runs; the only one of the workspace if left out.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Every run; reports that are up to date are kept.")] = False,
    metrics: Annotated[
        str, typer.Option(help="Groups of figures, with commas between: prediction, rollout, control.")
    ] = "prediction,rollout",
    split: Annotated[str, typer.Option(help="The episodes to score on: test or validation.")] = "test",
    horizon: Annotated[int, typer.Option(min=1, help="Steps of a rollout.")] = 15,
    batch_size: Annotated[int, typer.Option(min=1, help="Triplets predicted at once; changes no figure.")] = 64,
    precision: Annotated[
        str, typer.Option(help="float32, or bf16: faster where the hardware has it, and the report says so.")
    ] = "float32",
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Score runs on the held-out episodes of their data sets."""
    from dmotion_bench.errors import UnknownName, UsageError
    from dmotion_bench.workspace import Workspace

    for kind, given, allowed in (
        ("split", split, ("test", "validation")),
        ("precision", precision, ("float32", "bf16")),
        ("device", device, ("auto", "cpu", "cuda")),
    ):
        if given not in allowed:
            raise UnknownName(kind, given, allowed)
    asked = _metrics(metrics)
    workspace = Workspace.current()
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
    )
    reports, failures = score_runs(paths, asked, settings, batch_size=batch_size, device=device, keep=every)
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
) -> tuple[dict[Path, Report], dict[str, str]]:
    """Score runs one after the other, with a progress bar; one that fails does not stop the rest.

    Args:
        keep: Whether reports that are up to date are left as they are.

    Returns:
        The report of each run, and by its name what went wrong with each that has none.
    """
    import torch

    from dmotion_bench.cli.progress import note, progress_bar
    from dmotion_bench.errors import DmbenchError, UsageError
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
                reports[path] = score_run(
                    path,
                    metrics=metrics,
                    settings=settings,
                    how=Execution(batch_size=batch_size, device=where, progress=show),
                    references=references,
                    renew=not keep,
                )
            except Exception as error:
                if len(paths) == 1:
                    raise
                failures[path.name] = str(error) if isinstance(error, DmbenchError) else repr(error)
                note(f"{path.name}: {failures[path.name]}")
    return reports, failures


def _metrics(text: str) -> tuple[Metric, ...]:
    from dmotion_bench.errors import UnknownName, UsageError

    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        if name not in METRICS:
            raise UnknownName("group of figures", name, METRICS)
    if "control" in asked:
        raise UsageError("control cannot be scored yet: there is no planner; leave it out of --metrics.")
    if not asked:
        raise UsageError(f"--metrics names no group of figures; known: {', '.join(METRICS)}.")
    chosen: list[Metric] = []
    if "prediction" in asked:
        chosen.append("prediction")
    if "rollout" in asked:
        chosen.append("rollout")
    return tuple(chosen)


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
