"""How many control steps a second a model allows, with everything this package does for speed and without.

Two ways of doing the same work, one control step of the paper's CEM with the same candidates:

- *together*: a tree of predictions, tasks side by side, one batch of frames after the other;
- *one by one*: every candidate of every iteration predicted by itself, frame after frame, nothing shared.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8

from dmotion_bench.actions import require_discrete
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import Decision, ModelAgent
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.mpc import GROUP
from dmotion_bench.planning.objectives.base import Evaluator, Objective
from dmotion_bench.planning.objectives.centres import Centres
from dmotion_bench.planning.objectives.feature import Feature
from dmotion_bench.planning.solvers.base import PlanContext
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.specs import EnvSpec

PAPERS = CrossEntropy()


class PlanningTogether:
    """Called, it takes one control step of several tasks side by side, as the control loop does.

    Args:
        model: Aligned or not: the work is the same.
        spec: What the objects look like.
        images: Starts and goals of the tasks; at least two.
        tasks: Side by side.
        device: Where the model runs.

    Attributes:
        frames_per_step: Predicted for one control step of one task.
    """

    def __init__(
        self,
        model: ForwardModel[Any],
        spec: EnvSpec,
        images: UInt8[np.ndarray, "n h w 3"],
        *,
        tasks: int = GROUP,
        device: torch.device | None = None,
    ) -> None:
        self._agent = ModelAgent(model, spec, PAPERS, _objective(model), device=device)
        self._seen, self._tasks, self._number = _observation(images, tasks), tasks, 0
        self._actions = len(require_discrete(spec.actions, "planning"))
        self._agent.reset(self._seen.current, self._seen.goals)
        plan = self._act().plan
        self.frames_per_step = plan.frames / tasks if plan else 0.0

    def __call__(self) -> float:
        """Take the step; how many it was, one of each task."""
        self._act()
        return self._tasks

    def _act(self) -> Decision:
        self._number += 1
        return self._agent.act(_context(self._seen, self._actions, self._number))


class PlanningOneByOne:
    """Called, it imagines one of the same candidates by itself, with nothing shared; arguments as above."""

    def __init__(
        self,
        model: ForwardModel[Any],
        spec: EnvSpec,
        images: UInt8[np.ndarray, "n h w 3"],
        *,
        device: torch.device | None = None,
    ) -> None:
        self._dynamics = ModelDynamics(model.to(device or torch.device("cpu")).eval(), device=device)
        self._seen = _observation(images, 1)
        self._evaluator = _objective(model).reset(spec, self._seen.current, self._seen.goals)
        actions = len(require_discrete(spec.actions, "planning"))
        drawn = np.random.default_rng(0).integers(0, actions, (1000, PAPERS.horizon))
        self._candidates = itertools.cycle(drawn)
        self.frames_per_step = float(PAPERS.samples * PAPERS.iterations * PAPERS.horizon)

    def __call__(self) -> float:
        """Imagine the next candidate; the part of a control step that it is."""
        rollout_costs(self._dynamics, self._evaluator, self._seen, next(self._candidates))
        return 1 / (PAPERS.samples * PAPERS.iterations)


def rollout_costs(
    dynamics: ModelDynamics, evaluator: Evaluator, seen: Observation, actions: Int[np.ndarray, " t"]
) -> list[float]:
    """What a sequence of a task's costs, step by step, predicted by itself."""
    with torch.inference_mode():
        carried = evaluator.begin(dynamics)
    costs, task = list[float](), torch.zeros(1, dtype=torch.long, device=dynamics.device)
    with dynamics.computing():
        state = dynamics.start(seen)
        for action in actions.tolist():
            taken = torch.tensor([action], device=dynamics.device)
            state = dynamics.step(state, taken)
            cost, carried = evaluator.step(dynamics, state, task, taken, carried)
            costs.append(float(cost.total))
    return costs


def _objective(model: ForwardModel[Any]) -> Objective:
    return Centres() if model.needs_pixels else Feature()


def _observation(images: UInt8[np.ndarray, "n h w 3"], tasks: int) -> Observation:
    order = np.arange(tasks)
    starts, goals = images[order % len(images)], images[(order + 1) % len(images)]
    return Observation(previous=starts, current=starts, goals=goals)


def _context(seen: Observation, actions: int, number: int) -> PlanContext:
    tasks = len(seen.current)
    return PlanContext(
        observation=seen,
        generators=tuple(np.random.default_rng([number, task]) for task in range(tasks)),
        blocked=np.zeros((tasks, actions), np.bool_),
    )
