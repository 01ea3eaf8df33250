"""Control: how near a model, a planner and a hundred steps bring the objects to where they should be.

A task's figure is its normalised distance: 1 at the start, 0 at the goal, from the simulator's positions, whatever
the model saw (``planning/problems.py``). ``control_distance[t]`` is the mean over tasks after t steps;
``control_success`` the share of tasks that end at 0.2 or less, ``control_success[x]`` at x or less;
``control_lost`` the number of objects that a task loses. Intervals are over the episodes that the tasks come from.

The references say what a figure means: ``idle`` (1 by definition), ``random``, ``oracle`` (the same planner with the
true simulator as its model) and ``scripted`` (rules that read the simulator).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dmotion_bench import __version__
from dmotion_bench.learning.checkpoint import weights_hash
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.control import (
    GROUP,
    STEPS,
    ControlProgress,
    ControlResult,
    ControlSettings,
    control,
)
from dmotion_bench.planning.controllers import Controller, ModelController, make_reference
from dmotion_bench.planning.journal import Journal
from dmotion_bench.planning.planner import DEFAULT_PLANNER, make_planner
from dmotion_bench.planning.problems import TaskDataset, load_problems, task_environment
from dmotion_bench.scoring.statistics import EpisodeBootstrap, Estimate

READ_AT = (10, 20, 40, 60, 80, 100)
SUCCESS = 0.2
THRESHOLDS = (0.1, 0.2, 0.5)


def score_control(
    model: ForwardModel[Any] | str,
    dataset: TaskDataset,
    *,
    tasks: Sequence[int] | int | None = None,
    steps: int = STEPS,
    planner: str = DEFAULT_PLANNER,
    cost: str | None = None,
    seed: int = 0,
    group: int = GROUP,
    device: torch.device | None = None,
    progress: Callable[[ControlProgress], None] = lambda _: None,
    checkpoint: Path | None = None,
) -> ControlResult:
    """Let a model, or a reference, work on the data set's stored tasks.

    Args:
        model: Aligned, or the name of a reference.
        dataset: With labels; its environment must be installed.
        tasks: Which; a number asks for the first so many, None for all.
        steps: Actions a task.
        planner: Of ``planner_names()``; references that do not plan ignore it.
        cost: Of ``planning.costs.COSTS``; None for what suits the model.
        seed: Of the planner's random numbers.
        group: Tasks side by side.
        device: Where the model runs.
        progress: Called after every control step.
        checkpoint: A file to go on from after an interruption; it is left there when all is done, so that asking
            again costs nothing. One that belongs to something else is overwritten.

    Raises:
        DatasetError: The data set stores no tasks, or this machine's simulator does not repeat the recording.
        UnknownName: No such task, planner, cost or reference.
    """
    problems = load_problems(dataset, tasks)
    settings = ControlSettings(steps=steps, seed=seed, group=group)
    controller = _controller(model, dataset, planner, cost, device)
    journal = Journal(
        checkpoint,
        {
            "version": __version__,
            "dataset": dataset.fingerprint,
            "who": model if isinstance(model, str) else weights_hash(model.state_dict()),
            "planner": repr(make_planner(planner)),
            "cost": cost,
            "device": "cpu" if device is None else device.type,
            "tasks": [problem.number for problem in problems],
            "steps": steps,
            "seed": seed,
            "group": group,
        },
    )
    return control(
        controller,
        problems,
        lambda: task_environment(dataset.recipe),
        settings,
        journal=journal,
        on_progress=progress,
    )


def control_figures(result: ControlResult, *, seed: int = 0) -> Mapping[str, Estimate]:
    """The figures of a report, by their fixed names."""
    bootstrap = EpisodeBootstrap(np.array(result.episodes), seed=seed)
    steps = result.distance.shape[1] - 1
    final = result.distance[:, -1]
    values = {f"control_distance[{at}]": result.distance[:, at] for at in sorted({*READ_AT, steps}) if at <= steps}
    values["control_success"] = (final <= SUCCESS).astype(np.float64)
    values |= {f"control_success[{limit}]": (final <= limit).astype(np.float64) for limit in THRESHOLDS}
    values["control_lost"] = result.lost[:, -1].astype(np.float64)
    estimates = {name: bootstrap.mean(samples) for name, samples in values.items()}
    return {name: estimate for name, estimate in estimates.items() if estimate is not None}


def _controller(
    model: ForwardModel[Any] | str, dataset: TaskDataset, planner: str, cost: str | None, device: torch.device | None
) -> Controller:
    chosen = make_planner(planner)
    if isinstance(model, str):
        return make_reference(model, dataset.spec, lambda: task_environment(dataset.recipe), chosen)
    return ModelController(model, dataset.spec, chosen, cost=cost, device=device)
