"""``dmbench plan``: one control task, watched while it is being solved."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.actions import Discrete
from dmotion_bench.cli.options import REFERENCES, ObjectiveName, ObjectiveSettings, PlannerName, PlannerSettings
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.learning.model import ForwardModel
    from dmotion_bench.planning.mpc import ControlResult
    from dmotion_bench.planning.tasks import Problem
    from dmotion_bench.scoring.control import ControlScoring
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
    planner_set: PlannerSettings = None,
    objective: ObjectiveName = None,
    objective_set: ObjectiveSettings = None,
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
    from dmotion_bench.planning.choices import DEFAULT_SOLVER
    from dmotion_bench.scoring.control import ControlScoring
    from dmotion_bench.workspace import Workspace

    if save is not None and save.suffix != ".rrd":
        raise UsageError(f"--save {str(save)!r} must end in .rrd, as Rerun knows its files by it.")
    chosen = ControlScoring(
        steps=steps,
        planner=planner or DEFAULT_SOLVER,
        planner_set=tuple(planner_set or ()),
        objective=objective,
        objective_set=tuple(objective_set or ()),
        seed=seed,
        group=1,
    )

    from dmotion_bench.planning.tasks import load_problems
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
    result = _solve(who, model, dataset, problem, chosen, save, window=window, web=web)
    summary = _summary(who, dataset, result, chosen.planner)
    if as_json:
        typer.echo(json.dumps(summary))
        return
    _show(summary, save)


def _solve(
    who: str,
    model: ForwardModel[Any] | None,
    dataset: Dataset,
    problem: Problem,
    chosen: ControlScoring,
    save: Path | None,
    *,
    window: bool,
    web: bool,
) -> ControlResult:
    """Run the control loop with a watcher; leave the viewer open afterwards until it is closed."""
    import torch

    from dmotion_bench.cli.live import live_recording
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.learning.driving import predicted
    from dmotion_bench.planning.choices import make_solver
    from dmotion_bench.planning.dynamics.model import in_units
    from dmotion_bench.planning.mpc import ControlProgress, ControlSettings, Scene, control
    from dmotion_bench.planning.tasks import task_environment
    from dmotion_bench.scoring.control import agent_of
    from dmotion_bench.viewing.control import SHOWN, control_blueprint, log_goal, log_step

    spec = dataset.spec
    agent, solver = agent_of(model or who, dataset, chosen), make_solver(chosen.planner, chosen.planner_set)
    pictures = model is not None and model.needs_pixels
    watched = window or web or save is not None
    blueprint = control_blueprint(spec, getattr(solver, "horizon", 5), pictures)
    title = f"{who}, task {problem.number} of {dataset.name}"
    with contextlib.ExitStack() as stack:
        recording = stack.enter_context(live_recording(title, blueprint, window=window, web=web, save=save))
        bar = stack.enter_context(progress_bar())
        row = bar.add_task(title, total=chosen.steps, status="")
        if watched:
            log_goal(recording, problem.goal_frame)

        def watch(scene: Scene) -> None:
            bar.update(row, status=f"distance {scene.distance[0]:.3f}")
            if not watched:
                return
            futures, seen = None, scene.context.observation
            if pictures and model is not None and scene.decision.plan is not None:
                best = in_units(model.inputs.actions, torch.from_numpy(scene.decision.plan.candidates[0, :SHOWN]))
                previous, current = (torch.from_numpy(images[0]) for images in (seen.previous, seen.current))
                futures = predicted(model, previous, current, best).numpy()
            world = scene.worlds[0]
            log_step(recording, spec, seen.step, world.frame, world.distance, scene.decision.plan, futures)

        def advance(progress: ControlProgress) -> None:
            bar.update(row, completed=progress.steps)

        return control(
            agent,
            [problem],
            lambda: task_environment(dataset.recipe),
            ControlSettings(steps=chosen.steps, seed=chosen.seed, group=1),
            watch=watch,
            on_progress=advance,
        )


def _summary(who: str, dataset: Dataset, result: ControlResult, planner: str) -> dict[str, Any]:
    from dmotion_bench.planning.agents import known_actions, was_taken

    spec = known_actions(dataset.spec)
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
        "actions": [
            (spec.names[action] if isinstance(spec, Discrete) else action.tolist()) if taken else None
            for action, taken in zip(result.actions[0], was_taken(result.actions[0]), strict=True)
        ],
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
        typer.echo(f"  {each:.0f} frames predicted a step, {summary['planning_seconds']:.1f} s of planning in all")
    if save is not None:
        typer.echo(f"Watch it with {command('dmbench view', save)}.")
