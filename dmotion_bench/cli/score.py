"""``dmbench score``: figures of trained runs on held-out episodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from dmotion_bench.api.settings import DEVICES, require_one_of
from dmotion_bench.cli.cache import CacheFolder, use_cache
from dmotion_bench.cli.jobs import executor_option, jobs_bar, workers_option
from dmotion_bench.cli.options import (
    METRICS,
    REFERENCES,
    AsJson,
    ColumnName,
    Device,
    ObjectiveName,
    ObjectiveSettings,
    PlannerName,
    PlannerSettings,
    listed,
)
from dmotion_bench.cli.stdout import print_json, say

if TYPE_CHECKING:
    from dmotion_bench.scoring.control import ControlScoring
    from dmotion_bench.scoring.figures import Figures
    from dmotion_bench.scoring.report import Report
    from dmotion_bench.scoring.settings import Metric, ScoreSettings
    from dmotion_bench.workspace import Workspace

_OF_MODELS: Final = ("split", "horizon", "batch_size", "precision", "device")
"""Options that decide how a model is scored, and nothing of a reference."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(score)


def score(
    context: typer.Context,
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
    column: ColumnName = None,
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
    workers: Annotated[
        int | None,
        workers_option(
            "How many jobs run at a time; they share the runs and, of control, also by a reference, groups of tasks. "
            "Default: with --all as many as there are processors and memory for, else one."
        ),
    ] = None,
    executor: Annotated[
        str | None,
        executor_option("Where the jobs run"),
    ] = None,
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
    from dmotion_bench.api.scoring import ScoreSettings, as_metrics, control_scoring, require_control

    asked = None if metrics is None else as_metrics([metrics], "--metrics")
    control = control_scoring(tasks, planner, planner_set, objective, objective_set, column=column)
    workspace = Workspace.current()
    if runs and (named := [run for run in runs if str(run) in REFERENCES and not run.exists()]):
        if len(named) < len(runs) or every:
            raise UsageError(
                "runs and references cannot be scored by the same command; name only references, or only runs."
            )
        if asked != ("control",) and (asked is not None or column is None):
            raise UsageError(f"{named[0]} is a reference for control; score it with '--metrics control'.")
        sources = {name: context.get_parameter_source(name) for name in _OF_MODELS}
        if typed := [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]:
            options = " and ".join(f"--{name.replace('_', '-')}" for name in typed)
            raise UsageError(f"a reference works on the tasks without a model's predictions; leave out {options}.")
        path = workspace.dataset(data)
        found = _references([str(one) for one in named], path, control, workspace, executor, workers)
        _show_references(found, path, control, as_json=as_json)
        return
    of_control = {"--planner": planner, "--planner-set": planner_set, "--objective": objective, "--tasks": tasks}
    require_control(asked, column, of_control)
    if every and runs:
        raise UsageError("--all scores every run; name runs or give --all, not both.")
    paths = workspace.all_runs() if every else list(dict.fromkeys(workspace.run(run, REFERENCES) for run in runs or []))
    if not paths:
        paths = [workspace.run(None)]

    settings = ScoreSettings(
        split="validation" if split == "validation" else "test",
        horizon=horizon,
        precision="bf16" if precision == "bf16" else "float32",
        control=control,
    )
    other = None if data is None else workspace.dataset(data)
    reports, failures = _scored(
        paths,
        asked,
        settings,
        workspace,
        every=every,
        executor=executor,
        workers=workers,
        device=device,
        batch_size=batch_size,
        data=other,
    )
    if as_json:
        summaries = [report.summary() | {"run": str(path)} for path, report in reports.items()]
        print_json({"reports": summaries})
    else:
        _show(reports, overview=len(paths) > 1)
    if failures:
        raise _failed(failures, paths)


def _scored(
    paths: list[Path],
    metrics: tuple[Metric, ...] | None,
    settings: ScoreSettings,
    workspace: Workspace,
    *,
    every: bool,
    executor: str | None,
    workers: int | None,
    device: str,
    batch_size: int,
    data: Path | None,
) -> tuple[dict[Path, Report], dict[Path, str]]:
    """Score runs in turn or by an executor, and show how far that is."""
    from dmotion_bench.api.scoring import score_runs
    from dmotion_bench.api.side_by_side import Hands, score_at_once, scored_in_turn
    from dmotion_bench.cli.progress import BarOnDemand, note

    how: dict[str, Any] = {"batch_size": batch_size, "data": data, "note": note}
    how |= {"warn": lambda told: say(told, err=True)}

    with BarOnDemand() as bar, jobs_bar("scoring") as (count, watch):
        hands = Hands(executor=executor, workers=workers, device=device, count=count, watch=watch)
        is_shared = every or workers is not None or executor is not None
        if is_shared and not scored_in_turn(paths, metrics, settings, hands, keep=every, data=data):
            return score_at_once(paths, metrics, settings, workspace, hands, keep=every, **how)
        return score_runs(paths, metrics, settings, device=device, keep=every, progress=bar, **how)


def _references(
    names: list[str],
    path: Path,
    scoring: ControlScoring,
    workspace: Workspace,
    executor: str | None,
    workers: int | None,
) -> dict[str, Figures]:
    """Score references for control, in turn or by an executor; what they did stays in the data set's cache."""
    from dmotion_bench.api.side_by_side import Hands, score_references_at_once
    from dmotion_bench.cli.progress import BarOnDemand

    if executor is None and workers is None:
        workers = 1
    with BarOnDemand() as bar, jobs_bar("scoring") as (count, watch):
        hands = Hands(executor=executor, workers=workers, device="cpu", count=count, watch=watch)
        return score_references_at_once(names, path, scoring, workspace, hands, bar)


def _show_references(found: dict[str, Figures], path: Path, scoring: ControlScoring, *, as_json: bool) -> None:
    from dmotion_bench.cli.report_table import show_control
    from dmotion_bench.storage.dataset import Dataset

    figures = {name: {figure: value.to_json() for figure, value in own.items()} for name, own in found.items()}
    dataset = Dataset.open(path).name
    if as_json:
        plain: dict[str, Any] = {
            "arch": None,
            "dataset": dataset,
            "labels": None,
            "seed": scoring.seed,
            "reference": {},
        }
        reports = [{"run": name, "model": name, **plain, "figures": own} for name, own in figures.items()]
        print_json({"reports": reports})
    else:
        show_control(figures, f"control on {dataset}")


def _show(reports: dict[Path, Report], *, overview: bool) -> None:
    from dmotion_bench.cli.report_table import show_overview, show_report

    if overview:
        show_overview(reports)
    else:
        for path, report in reports.items():
            show_report(report, path)


def _failed(failures: dict[Path, str], paths: list[Path]) -> Exception:
    from dmotion_bench.api.scoring import names_apart
    from dmotion_bench.errors import RunError

    names = names_apart(paths)
    listed = "\n".join(f"  {names[path]}: {error}" for path, error in failures.items())
    return RunError(f"{len(failures)} of {len(paths)} runs could not be scored:\n{listed}")
