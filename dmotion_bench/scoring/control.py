"""Control: how near to their goals a model and a planner bring the objects in a hundred steps.

A task's figure is its normalised distance: 1 at the start, 0 at the goal, from the simulator's positions, whatever
the model saw (``planning/tasks.py``). What becomes of the samples of it stands in ``figures.py``. Where an environment
tells no positions its pictures judge, and samples and figures have names of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import torch

from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.settings import require_use
from dmotion_bench.planning.agents import Agent, ModelAgent, make_reference
from dmotion_bench.planning.choices import (
    DEFAULT_SOLVER,
    SIMULATOR,
    default_objective,
    make_objective,
    make_solver,
    planning_configuration,
    present_name,
)
from dmotion_bench.planning.columns import Column, column_named
from dmotion_bench.planning.mpc import (
    CONTROL_VERSION,
    GROUP,
    STEPS,
    ControlProgress,
    ControlResult,
    ControlSettings,
    control,
)
from dmotion_bench.planning.objectives.base import Objective, taught
from dmotion_bench.planning.objectives.true_cost import TrueCost
from dmotion_bench.planning.tasks import Judge, Problem, load_problems, task_environment
from dmotion_bench.scoring.earlier_planning import present_settings
from dmotion_bench.scoring.kept_control import journal_of
from dmotion_bench.scoring.samples import CONTROL, PICTURE_CONTROL, SampleRows
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.values import require_bounds

_OF_COLUMN: Final = ("planner", "planner_set", "objective", "objective_set")
"""The settings that a column decides."""

Advance = Callable[[ControlProgress], None]


@dataclass(frozen=True, kw_only=True)
class ControlScoring:
    """The settings that decide the figures of control, besides the weights and the data.

    Attributes:
        tasks: So many of the data set's first tasks; None for all.
        steps: Actions a task.
        planner: The solver's name; references that do not plan ignore it.
        planner_set: ``KEY=VALUE`` for its fields that differ from their defaults.
        objective: The objective's name; None for the one that suits (``default_objective``).
        objective_set: As ``planner_set``; of an objective that is named.
        seed: Of the solver's random numbers.
        group: Tasks side by side; it only decides which numbers are rounded together.
        column: The name of a frozen planner of the table of control (``planning/columns.py``), in place of a planner
            and an objective.
    """

    tasks: int | None = None
    steps: int = STEPS
    planner: str = DEFAULT_SOLVER
    planner_set: tuple[str, ...] = ()
    objective: str | None = None
    objective_set: tuple[str, ...] = ()
    seed: int = 0
    group: int = GROUP
    column: str | None = None

    def __post_init__(self) -> None:
        if self.column is not None:
            self._take(column_named(self.column))
        if self.tasks is not None and self.tasks < 1:
            raise InvalidSetting(f"tasks is {self.tasks}; control is scored on 1 or more.")
        require_bounds(self, from_one=("steps", "group"), from_zero=("seed",))
        make_solver(self.planner, self.planner_set)
        if self.objective is not None:
            object.__setattr__(self, "objective", present_name(self.objective))
            make_objective(self.objective, self.objective_set)
        elif self.objective_set:
            raise InvalidSetting(
                f"{', '.join(self.objective_set)} is set, and no objective is named; name one with '--objective'."
            )

    def to_json(self) -> dict[str, Any]:
        """The settings as a report stores them: with a prefix, and with the version of control."""
        own = asdict(self) | {"version": CONTROL_VERSION}
        if self.column is None:
            del own["column"]
        return {f"{CONTROL}_{name}": list(one) if isinstance(one, tuple) else one for name, one in own.items()}

    def _take(self, column: Column) -> None:
        """Take a column's planner.

        Raises:
            InvalidSetting: Another one was named, too.
        """
        frozen = {name: getattr(column, name) for name in _OF_COLUMN}
        named = {name: getattr(self, name) for name in _OF_COLUMN}
        plain = {one.name: one.default for one in fields(self) if one.name in _OF_COLUMN}
        if named not in (plain, frozen):
            raise InvalidSetting(
                f"the column {column.name!r} says how to plan; leave out the planner, the objective and their settings."
            )
        for name, value in frozen.items():
            object.__setattr__(self, name, value)

    def require_use(self, actions: ActionSpec | None) -> None:
        """Refuse settings that do nothing with the actions of an environment, except a column's, which are frozen.

        A stored report may hold some, so it is not asked for one.

        Raises:
            InvalidSetting: One is for the other kind of action.
        """
        if self.column is not None:
            return
        require_use(make_solver(self.planner, self.planner_set), actions, "--planner-set")
        if self.objective is not None:
            require_use(make_objective(self.objective, self.objective_set), actions, "--objective-set")

    def groups(self, known: int) -> list[tuple[int, ...]]:
        """The numbers of the tasks, in groups that are worked on together.

        Args:
            known: How many tasks the data set has.
        """
        count = known if self.tasks is None else min(self.tasks, known)
        return [tuple(range(first, min(first + self.group, count))) for first in range(0, count, self.group)]

    def planned_with(self, dataset: ReadableDataset, *, needs_pixels: bool | None) -> tuple[str, Objective]:
        """The objective's name, and the objective.

        Args:
            dataset: Whose environment may name the one that suits.
            needs_pixels: The model's; None for the true simulator in a model's place, which has its own.
        """
        name = self.objective
        if self.column is not None:
            name = column_named(self.column).objective_for(dataset.spec, needs_pixels=needs_pixels is not False)
        elif name is None and needs_pixels is None:
            return SIMULATOR, TrueCost()
        if name is None:
            name = default_objective(dataset.recipe.environment, dataset.spec, needs_pixels=bool(needs_pixels))
        return name, make_objective(name, self.objective_set)

    def planning(self, dataset: ReadableDataset, *, needs_pixels: bool | None) -> dict[str, Any]:
        """The solver and the objective in full, see ``planning_configuration``."""
        solver = make_solver(self.planner, self.planner_set)
        return planning_configuration(self.planner, solver, *self.planned_with(dataset, needs_pixels=needs_pixels))

    @classmethod
    def from_json(cls, settings: Mapping[str, Any]) -> ControlScoring:
        """Read the settings back from those of a report, which may be an earlier one."""
        present = present_settings(settings)
        always = (one.name for one in fields(cls) if one.name != "column")
        read: dict[str, Any] = {name: present[f"{CONTROL}_{name}"] for name in always}
        read["column"] = present.get(f"{CONTROL}_column")
        for name in ("planner_set", "objective_set"):
            read[name] = tuple(read[name])
        return cls(**read)


def score_control(
    model: ForwardModel[Any] | str,
    dataset: ReadableDataset,
    scoring: ControlScoring | None = None,
    *,
    device: torch.device | None = None,
    progress: Advance = lambda _: None,
    checkpoint: Path | None = None,
    begun: Path | None = None,
    numbers: Sequence[int] | None = None,
    problems: Sequence[Problem] | None = None,
) -> ControlResult:
    """Let a model or a reference work on the tasks that the data set stores.

    Args:
        model: Aligned, or the name of a reference.
        dataset: With labels; its environment must be installed.
        scoring: Which tasks, and how.
        device: Where the model runs.
        progress: Called after every control step.
        checkpoint: A file to go on from after an interruption; it is left there when all is done, so that asking
            again costs nothing, and asking for more tasks only those. One that belongs to something else is
            overwritten. Shares of it (``share_of``) are taken over.
        begun: Another such file, whose progress with these tasks is taken over where it is ahead.
        numbers: Of the tasks to work on, in place of those of ``scoring``; whole groups, or the rounding differs.
        problems: The tasks to work on, where they are loaded already.

    Raises:
        DatasetError: The data set stores no tasks, or this machine's simulator does not repeat the recording.
        LabelsNotAvailable: It is a recording of something that is not here to be controlled.
        UnknownName: No such task, planner, objective or reference.
    """
    scoring = scoring or ControlScoring()
    if problems is None:
        require_tasks(dataset)
        problems = load_problems(dataset, scoring.tasks if numbers is None else numbers)
    journal = journal_of(checkpoint, model, dataset, scoring, device)
    if begun is not None:
        journal.take_over(begun, only={problem.number for problem in problems})
    return control(
        agent_of(model, dataset, scoring, device),
        problems,
        lambda: task_environment(dataset.recipe),
        ControlSettings(steps=scoring.steps, seed=scoring.seed, group=scoring.group),
        journal=journal,
        on_progress=progress,
    )


def require_tasks(dataset: ReadableDataset) -> None:
    """Raise an error if control cannot be scored on a data set.

    Raises:
        DatasetError: The data set stores no tasks.
        LabelsNotAvailable: It is a recording of something that is not here to be controlled.
    """
    if dataset.recipe.environment == "imported":
        raise LabelsNotAvailable(
            f"{dataset.name!r} was imported, so there is no environment to act in and control cannot be scored; "
            "leave it out: '--metrics prediction,rollout'."
        )
    if not dataset.tasks():
        load_problems(dataset)


def control_samples(predictor: str, result: ControlResult) -> pa.Table:
    """The samples of control: one row for each task and step, including the start."""
    moments, discrete = result.distance.shape[1], result.actions.ndim == 2
    by_pictures = result.judge is Judge.PICTURES
    rows = SampleRows(PICTURE_CONTROL if by_pictures else CONTROL, predictor)
    for place, (task, episode) in enumerate(zip(result.tasks, result.episodes, strict=True)):
        taken = result.actions[place]
        nothing = np.full((1, *taken.shape[1:]), -1 if discrete else np.nan)
        actions = np.concatenate([taken, nothing.astype(taken.dtype)])  # behind the last moment stands no action
        rows.add(
            {
                "episode": np.full(moments, episode),
                "step": np.full(moments, result.starts[place]),
                "ahead": np.arange(moments),
                "action": actions if discrete else np.full(moments, -1),
                **({} if discrete else {"command": actions}),
                "task": np.full(moments, task),
                "control_distance": result.distance[place],
            }
            | ({} if by_pictures else {"control_lost": result.lost[place]})
        )
    return rows.table()


def agent_of(
    model: ForwardModel[Any] | str,
    dataset: ReadableDataset,
    scoring: ControlScoring,
    device: torch.device | None = None,
) -> Agent:
    """Whoever acts: a model with its solver and objective, or a reference by its name."""
    solver = make_solver(scoring.planner, scoring.planner_set)
    needs_pixels = None if isinstance(model, str) else model.needs_pixels
    objective = taught(scoring.planned_with(dataset, needs_pixels=needs_pixels)[1], dataset)
    if isinstance(model, str):
        return make_reference(model, dataset.spec, lambda: task_environment(dataset.recipe), solver, objective)
    return ModelAgent(model, dataset.spec, solver, objective, device=device)
