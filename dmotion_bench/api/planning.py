"""One control task, solved by a model's predictions or by a reference, and watched while it is."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, SupportsIndex

import rerun as rr
import rerun.blueprint as rrb
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.scoring import control_scoring
from dmotion_bench.api.settings import Settings, whole
from dmotion_bench.errors import UsageError
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.driving import predicted
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.agents import REFERENCES, Agent, known_actions, was_taken
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.dynamics.model import in_units
from dmotion_bench.planning.mpc import ControlProgress, ControlResult, ControlSettings, Scene, control
from dmotion_bench.planning.tasks import Problem, World, load_problems, task_environment
from dmotion_bench.scoring.control import ControlScoring, agent_of
from dmotion_bench.specs import IMPORTED
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.control import SHOWN, control_blueprint, log_goal, log_step
from dmotion_bench.viewing.filmstrip import Film, filmstrip, write_filmstrip
from dmotion_bench.viewing.live import recording_to
from dmotion_bench.workspace import AnyPath, Workspace, as_path, in_workspace

STRIP: Final = ".png"


@dataclass(frozen=True, kw_only=True)
class Planned:
    """How a control task went.

    Attributes:
        run: The run's or the reference's name.
        dataset: The data set's name.
        task: The task's number.
        planner: The solver's name.
        steps: Actions taken.
        distance: Normalised, at the start and after each step: 1 at the start, 0 at the goal.
        final_distance: The last of them.
        lost: Objects that are gone at the end.
        actions: Names of discrete actions, or numbers in their units; None where none was taken.
        frames: Predicted in all.
        planning_seconds: Spent on planning [s].
    """

    run: str
    dataset: str
    task: int
    planner: str
    steps: int
    distance: list[float]
    final_distance: float
    lost: int
    actions: list[Any]
    frames: int
    planning_seconds: float

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench plan --json`` prints."""
        return asdict(self)


@in_workspace
def plan(
    run: AnyPath | None = None,
    task: SupportsIndex = 0,
    *,
    planner: str | None = None,
    planner_settings: Settings = None,
    objective: str | None = None,
    objective_settings: Settings = None,
    steps: SupportsIndex = 100,
    seed: SupportsIndex = 0,
    data: AnyPath | None = None,
    save: AnyPath | None = None,
    column: str | None = None,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Planned:
    """Plan one control task with a model, and act in the simulator.

    Args:
        run: A trained run, by folder or name, or a reference: ``"idle"``, ``"random"``, ``"oracle"``, ``"scripted"``.
            Default: the workspace's only run.
        task: Its number in the data set.
        planner, planner_settings: The solver, ``"cem"`` by default, and its fields that differ from their defaults.
        objective, objective_settings: Likewise; None for the one that suits.
        steps: Number of actions.
        seed: Of the solver's random numbers.
        data: The data set with the task. Default: the one of the training.
        save: A file ``FILE.rrd`` to watch it in Rerun afterwards, or ``FILE.png`` for a filmstrip of a few moments.
        column: Of the table of control, in place of the planner and the objective.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told after every step, or True for a bar.

    Raises:
        RunMissing, UnknownName: There is no such run, task, planner or objective.
        UsageError: The data set was imported, so nobody can act in it; ``save`` is no such file; a number is out of its
            bounds; a column and a planner are named; or a setting does nothing with the environment's actions.
        DatasetError: The data set stores no tasks.

    Example:
        >>> planned = dm.plan("oracle", steps=2, data="grid_world-tiny", planner_settings={"horizon": 1})
        >>> planned.distance[0], len(planned.actions)
        (1.0, 2)
    """
    file = None if save is None else as_path("file", save)
    require_known_suffix("save", file)
    task, steps, seed = whole("task", task, 0), whole("steps", steps, 1), whole("seed", seed, 0)
    chosen = control_scoring(
        None, planner, planner_settings, objective, objective_settings, steps=steps, seed=seed, group=1, column=column
    )
    place = Workspace.current()
    trial = open_trial(run, task, chosen, place, data)
    if file is None or file.suffix == STRIP:
        return trial.solve(progress=progress, strip=file)
    with recording_to(trial.title, trial.blueprint, file=file) as recording:
        return trial.solve(recording, progress)


def require_known_suffix(option: str, file: Path | None) -> None:
    """Refuse a file that is neither for Rerun nor a filmstrip.

    Raises:
        UsageError: It ends in something else.
    """
    if file is not None and file.suffix not in (".rrd", STRIP):
        raise UsageError(f"{option} {str(file)!r} must end in .rrd, for Rerun, or in {STRIP}, for a filmstrip.")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A control task and who is to solve it.

    Attributes:
        who: The run's or the reference's name.
        model: None for a reference.
        dataset, problem: The task.
        chosen: How it is planned.
        agent: Who acts.
    """

    who: str
    model: ForwardModel[Any] | None
    dataset: Dataset
    problem: Problem
    chosen: ControlScoring
    agent: Agent

    @property
    def title(self) -> str:
        """What a recording of it is called."""
        return f"{self.who}, task {self.problem.number} of {self.dataset.name}"

    @cached_property
    def blueprint(self) -> rrb.Blueprint:
        """How a recording of it is laid out."""
        return control_blueprint(self.dataset.spec, self._horizon, self._pictures)

    @property
    def _horizon(self) -> int:
        solver = make_solver(self.chosen.planner, self.chosen.planner_set)
        return int(getattr(solver, "horizon", 5))

    @property
    def _pictures(self) -> bool:
        return self.model is not None and self.model.needs_pixels

    def solve(
        self, recording: rr.RecordingStream | None = None, progress: Progress = None, strip: Path | None = None
    ) -> Planned:
        """Run the control loop.

        Args:
            recording: Where every step is logged to, as ``blueprint`` lays it out.
            progress: Told after every step.
            strip: A file for a filmstrip.

        Raises:
            ViewerError: The filmstrip cannot be written.
        """
        film, worlds = Film(), list[World]()
        if recording is not None:
            log_goal(recording, self.problem.goal_frame)
        said = [""]
        with telling(progress) as tell:

            def watch(scene: Scene) -> None:
                said[0] = f"distance {scene.distance[0]:.3f}"
                if strip is not None:
                    film.take(scene.context.observation)
                    worlds[:] = scene.worlds
                if recording is not None:
                    self._log(recording, scene)

            def advance(told: ControlProgress) -> None:
                tell(
                    JobProgress(what=self.title, done=told.steps, total=self.chosen.steps, status=said[0], unit="steps")
                )

            result = control(
                self.agent,
                [self.problem],
                lambda: task_environment(self.dataset.recipe),
                ControlSettings(steps=self.chosen.steps, seed=self.chosen.seed, group=1),
                watch=watch,
                on_progress=advance,
            )
        if strip is not None:
            film.current.append(worlds[0].frame)
            shown = self.model if self._pictures else None
            distance, actions = result.distance[0], result.actions[0]
            picture = filmstrip(
                film,
                self.problem.goal_frame,
                distance,
                actions,
                shown,
                ahead=self._horizon,
                title=self.title,
                lost=int(result.lost[0, -1]),
            )
            write_filmstrip(picture, strip)
        return self._planned(result)

    def _log(self, recording: rr.RecordingStream, scene: Scene) -> None:
        futures, seen, model = None, scene.context.observation, self.model
        if self._pictures and model is not None and scene.decision.plan is not None:
            best = in_units(model.inputs.actions, as_tensor(scene.decision.plan.candidates[0, :SHOWN]))
            previous, current = (torch.from_numpy(images[0]) for images in (seen.previous, seen.current))
            futures = predicted(model, previous, current, best).numpy()
        world = scene.worlds[0]
        log_step(recording, self.dataset.spec, seen.step, world.frame, world.distance, scene.decision.plan, futures)

    def _planned(self, result: ControlResult) -> Planned:
        spec = known_actions(self.dataset.spec)
        distance = result.distance[0].round(6).tolist()
        return Planned(
            run=self.who,
            dataset=self.dataset.name,
            task=result.tasks[0],
            planner=self.chosen.planner,
            steps=len(distance) - 1,
            distance=distance,
            final_distance=distance[-1],
            lost=int(result.lost[0, -1]),
            actions=[
                (spec.names[action] if isinstance(spec, Discrete) else action.tolist()) if taken else None
                for action, taken in zip(result.actions[0], was_taken(result.actions[0]), strict=True)
            ],
            frames=result.frames,
            planning_seconds=round(result.seconds, 3),
        )


def open_trial(
    run: AnyPath | None, task: int, chosen: ControlScoring, workspace: Workspace, data: AnyPath | None = None
) -> Trial:
    """The control task of a run's data set, or of another one, and who is to solve it.

    Args:
        run: A run, or the name of a reference.
        task: The task's number.
        chosen: How it is planned.
        workspace: Where runs and data sets are looked for.
        data: The data set; a reference takes the only one if none is named.

    Raises:
        RunMissing, UnknownName, UsageError, DatasetError: As ``plan``.
    """
    model: ForwardModel[Any] | None = None
    if run is not None and str(run) in REFERENCES and not Path(run).exists():
        dataset, who = Dataset.open(workspace.dataset(data)), str(run)
    else:
        opened = Run.open(workspace.run(run, REFERENCES))
        opened.require_aligned()
        dataset = dataset_of(opened, Dataset) if data is None else Dataset.open(workspace.dataset(data))
        who = opened.name
        model = opened.model
    if dataset.recipe.environment == IMPORTED:
        raise UsageError(f"{dataset.name!r} was imported, so there is no environment to plan and act in.")
    chosen.require_use(dataset.spec.actions)
    (problem,) = load_problems(dataset, [task])
    agent = agent_of(model or who, dataset, chosen)
    return Trial(who=who, model=model, dataset=dataset, problem=problem, chosen=chosen, agent=agent)
