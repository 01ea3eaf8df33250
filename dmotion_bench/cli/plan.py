"""``dmbench plan``: one control task, watched while it is being solved."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.actions import require_discrete
from dmotion_bench.cli.options import COSTS, REFERENCES, CostName, PlannerName, require_one_of
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.learning.model import ForwardModel
    from dmotion_bench.planning.control import ControlResult
    from dmotion_bench.planning.planner import Planner
    from dmotion_bench.planning.problems import Problem
    from dmotion_bench.storage.dataset import Dataset


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
    cost: CostName = None,
    steps: Annotated[int, typer.Option(min=1, help="Number of actions to take.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the planner's random numbers.")] = 0,
    data: Annotated[
        Path | None, typer.Option(help="Data set with the tasks. Default: the one that the run was trained on.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show the task on a local web page instead of in a window.")
    ] = False,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a Rerun file instead of opening a window.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as one JSON object and open no window.")
    ] = False,
) -> None:
    """Plan one control task with a model and watch it in Rerun."""
    from dmotion_bench.errors import UsageError
    from dmotion_bench.planning.planner import DEFAULT_PLANNER, make_planner
    from dmotion_bench.workspace import Workspace

    if save is not None and save.suffix != ".rrd":
        raise UsageError(f"--save {str(save)!r} must end in .rrd, as Rerun knows its files by it.")
    if cost is not None:
        require_one_of("cost", cost, COSTS)
    name = planner or DEFAULT_PLANNER
    chosen = make_planner(name)

    from dmotion_bench.planning.problems import load_problems
    from dmotion_bench.specs import IMPORTED
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.viewer import require_display

    workspace = Workspace.current()
    model: ForwardModel[Any] | None = None
    if str(run) in REFERENCES and not run.exists():
        dataset, who = Dataset.open(workspace.dataset(data)), str(run)
    else:
        from dmotion_bench.learning.run import Run

        opened = Run.open(workspace.run(run))
        opened.require_aligned()
        dataset, who = Dataset.open(opened.dataset_path if data is None else workspace.dataset(data)), opened.name
        model = opened.model
    if dataset.recipe.environment == IMPORTED:
        raise UsageError(f"{dataset.name!r} was imported, so there is no environment to plan and act in.")
    problem = load_problems(dataset, [task])[0]
    if window := not (web or save or as_json):
        require_display()  # said before the work, not after it
    result = _solve(who, model, dataset, problem, chosen, cost, steps, seed, save, window=window, web=web)
    summary = _summary(who, dataset, result, name)
    if as_json:
        typer.echo(json.dumps(summary))
        return
    _show(summary, save)


def _solve(
    who: str,
    model: ForwardModel[Any] | None,
    dataset: Dataset,
    problem: Problem,
    planner: Planner,
    cost: str | None,
    steps: int,
    seed: int,
    save: Path | None,
    *,
    window: bool,
    web: bool,
) -> ControlResult:
    """Run the control loop with a watcher; leave the viewer open afterwards until it is closed."""
    import torch

    from dmotion_bench.cli.live import live_recording
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.planning.control import ControlProgress, ControlSettings, Scene, control
    from dmotion_bench.planning.controllers import ModelController, make_reference
    from dmotion_bench.planning.driving import imagined
    from dmotion_bench.planning.problems import task_environment
    from dmotion_bench.viewing.control import SHOWN, control_blueprint, log_goal, log_step

    spec = dataset.spec
    controller = (
        make_reference(who, spec, lambda: task_environment(dataset.recipe), planner, cost)
        if model is None
        else ModelController(model, spec, planner, cost=cost)
    )
    pictures = model is not None and model.needs_pixels
    watched = window or web or save is not None
    blueprint = control_blueprint(spec, getattr(planner, "horizon", 5), pictures)
    title = f"{who}, task {problem.number} of {dataset.name}"
    with contextlib.ExitStack() as stack:
        recording = stack.enter_context(live_recording(title, blueprint, window=window, web=web, save=save))
        bar = stack.enter_context(progress_bar())
        row = bar.add_task(title, total=steps, status="")
        if watched:
            log_goal(recording, problem.goal_frame)

        def watch(scene: Scene) -> None:
            bar.update(row, status=f"distance {scene.distance[0]:.3f}")
            if not watched:
                return
            futures = None
            if pictures and model is not None and scene.decision.plan is not None:
                seen, best = scene.seen, torch.from_numpy(scene.decision.plan.candidates[0, :SHOWN])
                previous, current = (torch.from_numpy(images[0]) for images in (seen.previous, seen.current))
                futures = imagined(model, previous, current, best).numpy()
            world = scene.worlds[0]
            log_step(recording, spec, scene.seen.step, world.frame, world.distance, scene.decision.plan, futures)

        def advance(progress: ControlProgress) -> None:
            bar.update(row, completed=progress.steps)

        return control(
            controller,
            [problem],
            lambda: task_environment(dataset.recipe),
            ControlSettings(steps=steps, seed=seed, group=1),
            watch=watch,
            on_progress=advance,
        )


def _summary(who: str, dataset: Dataset, result: ControlResult, planner: str) -> dict[str, Any]:
    names = require_discrete(dataset.spec.actions, "planning").names
    distance = result.distance[0].round(6).tolist()
    return {
        "run": who,
        "dataset": dataset.name,
        "task": result.tasks[0],
        "planner": planner,
        "steps": len(distance) - 1,
        "distance": distance,
        "final_distance": distance[-1],
        "lost": int(result.lost[0, -1]),
        "actions": [names[action] if action >= 0 else None for action in result.actions[0].tolist()],
        "frames": result.frames,
        "planning_seconds": round(result.seconds, 3),
    }


def _show(summary: dict[str, Any], save: Path | None) -> None:
    distance = summary["distance"]
    typer.echo(f"{summary['run']}, task {summary['task']} of {summary['dataset']}")
    readings = ", ".join(f"{distance[at]:.3f} after {at}" for at in (10, 20, 40, 60, 80) if at < len(distance) - 1)
    typer.echo(f"  distance 1.000 at the start, {readings + ', ' if readings else ''}", nl=False)
    typer.echo(f"{distance[-1]:.3f} after {summary['steps']} steps")
    if summary["lost"]:
        typer.echo(f"  {summary['lost']} object(s) lost, each counting 1")
    if summary["frames"]:
        each = summary["frames"] / summary["steps"]
        typer.echo(f"  {each:.0f} frames imagined a step, {summary['planning_seconds']:.1f} s of planning in all")
    if save is not None:
        typer.echo(f"Watch it with {command('dmbench view', save)}.")
