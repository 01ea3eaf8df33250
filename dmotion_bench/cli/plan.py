"""``dmbench plan``: one control task, watched while it is being solved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.options import ObjectiveName, ObjectiveSettings, PlanColumnName, PlannerName, PlannerSettings
from dmotion_bench.cli.stdout import print_json, reserve_stdout, say
from dmotion_bench.wording import command, counted, shown

if TYPE_CHECKING:
    from dmotion_bench.api.planning import Planned


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(plan)


def plan(
    run: Annotated[
        Path,
        typer.Argument(help="A run, by path or name, or a reference to compare with: idle, random, oracle, scripted."),
    ],
    task: Annotated[int, typer.Option(min=0, help="Number of the control task in the data set.")] = 0,
    planner: PlannerName = None,
    planner_set: PlannerSettings = None,
    objective: ObjectiveName = None,
    objective_set: ObjectiveSettings = None,
    column: PlanColumnName = None,
    steps: Annotated[int, typer.Option(min=1, help="Number of actions to take.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the planner's random numbers.")] = 0,
    data: Annotated[
        Path | None, typer.Option(help="Data set with the tasks. Default: the one that the run was trained on.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show the task on a local web page instead of in a window.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a file instead of opening a window: FILE.rrd for Rerun, or FILE.png for a filmstrip of a few "
            "moments, seen and imagined.",
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", callback=reserve_stdout, help="Print the result as one JSON object and open no window."),
    ] = False,
) -> None:
    """Plan one control task with a model and watch it in Rerun."""
    from dmotion_bench.api.planning import STRIP, open_trial, require_known_suffix
    from dmotion_bench.api.scoring import control_scoring
    from dmotion_bench.cli.live import live_recording
    from dmotion_bench.cli.progress import BarOnDemand
    from dmotion_bench.errors import UsageError
    from dmotion_bench.viewing.viewer import require_display
    from dmotion_bench.workspace import Workspace

    require_known_suffix("--save", save)
    if as_json and web:
        raise UsageError("--json shows nothing, and --web shows a page; leave out one of them.")
    chosen = control_scoring(
        None, planner, planner_set, objective, objective_set, steps=steps, seed=seed, group=1, column=column
    )
    trial = open_trial(run, task, chosen, Workspace.current(), data)
    if window := not (web or save or as_json):
        require_display()  # said before the work, not after it
    strip = save if save is not None and save.suffix == STRIP else None
    film = save if strip is None else None
    watched = window or web or film is not None
    with (
        live_recording(trial.title, trial.blueprint, window=window, web=web, save=film) as shown,
        BarOnDemand() as bar,
    ):
        planned = trial.solve(shown.recording if watched else None, bar, strip)
        bar.end()  # the viewer may stay open for long
    if as_json:
        print_json(planned.to_json())
        return
    _show(planned, save)


def _show(planned: Planned, save: Path | None) -> None:
    distance = planned.distance
    say(f"{planned.run}, task {planned.task} of {planned.dataset}")
    readings = ", ".join(f"{distance[at]:.3f} after {at}" for at in (10, 20, 40, 60, 80) if at < len(distance) - 1)
    say(f"  distance 1.000 at the start, {readings + ', ' if readings else ''}", nl=False)
    say(f"{distance[-1]:.3f} after {counted(planned.steps, 'step')}")
    if planned.lost:
        say(f"  {counted(planned.lost, 'object')} lost, each adding 1")
    if planned.frames:
        each = planned.frames / planned.steps
        say(f"  {each:.0f} frames predicted a step, {planned.planning_seconds:.1f} s of planning in all")
    if save is not None and save.suffix == ".rrd":
        say(f"Watch it with {command('dmbench view', save)}.")
    elif save is not None:
        say(f"The filmstrip is {shown(str(save))}.")
