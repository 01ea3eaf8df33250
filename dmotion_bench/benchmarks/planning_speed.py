"""How many control steps a second a model allows, with everything this package does for speed and without.

Two ways of doing the same work, one control step of the planner of the control table's first column (``HEADLINE``):

- *together*: a tree of predictions, tasks side by side, one batch of frames after the other;
- *one by one*: every candidate of every iteration predicted by itself, frame after frame, nothing shared.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch.utils.flop_counter import FlopCounterMode

from dmotion_bench.actions import require_discrete
from dmotion_bench.benchmarks.training_step import untrained
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import ModelAgent
from dmotion_bench.planning.columns import HEADLINE
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.mpc import GROUP
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.objectives.checked import checked_reset
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Sequences
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.registry import model_class
from dmotion_bench.specs import EnvSpec, Preset


def planned_model(name: str, images: UInt8[np.ndarray, "n h w 3"]) -> tuple[ForwardModel[Any], float]:
    """An untrained model as a planner has it, and the floating-point operations of a prediction.

    Args:
        name: Registry name.
        images: One of them is predicted from.
    """
    kind = model_class(name)
    arch = kind.architectures[0]
    channels_last = kind.training_defaults(Preset.SMALL, arch).channels_last
    model = untrained(name, arch).laid_out(channels_last=channels_last).eval()
    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        image = to_model(torch.from_numpy(images[:1]))
        model.advance(model.begin(image, image), torch.zeros(1, dtype=torch.long))
    return model, counter.get_total_flops()


class PlanningTogether:
    """Called, it takes control steps of several tasks side by side, from one search to the next.

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
        solver, objective = HEADLINE.made(spec, needs_pixels=model.needs_pixels)
        self._agent = ModelAgent(model, spec, solver, objective, device=device)
        self._memory: Sequences | None = None
        self._seen, self._tasks, self._number = _observation(images, tasks), tasks, 0
        self._actions = len(require_discrete(spec.actions, "planning"))
        self._agent.reset(self._seen.current, self._seen.goals)
        self._turn = getattr(solver, "replan_every", 1)
        self._take_turn()  # remembers nothing yet, as only the first of a task's steps does
        self.frames_per_step = self._take_turn() / self._turn / tasks

    def __call__(self) -> float:
        """Take the steps from one search to the next; how many they were, for all tasks."""
        self._take_turn()
        return self._turn * self._tasks

    def _take_turn(self) -> int:
        """Take these steps; the frames that they predicted."""
        return sum(self._act().frames for _ in range(self._turn))

    def _act(self) -> Plan:
        plan = self._agent.act(_context(self._seen, self._actions, self._number, self._memory)).plan
        assert plan is not None, "an agent that has a model plans"
        self._number += 1
        self._memory = plan.memory
        return plan


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
        solver, objective = HEADLINE.made(spec, needs_pixels=model.needs_pixels)
        assert isinstance(solver, CrossEntropy), "whose candidates are counted here"
        self._evaluator = checked_reset(objective, spec, self._seen.current, self._seen.goals)
        actions = len(require_discrete(spec.actions, "planning"))
        drawn = np.random.default_rng(0).integers(0, actions, (1000, solver.horizon))
        self._candidates, self._count = itertools.cycle(drawn), solver.samples * solver.iterations
        self.frames_per_step = float(self._count * solver.horizon)

    def __call__(self) -> float:
        """Imagine the next candidate; the part of a control step that it is."""
        rollout_costs(self._dynamics, self._evaluator, self._seen, next(self._candidates))
        return 1 / self._count


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


def _observation(images: UInt8[np.ndarray, "n h w 3"], tasks: int) -> Observation:
    order = np.arange(tasks)
    starts, goals = images[order % len(images)], images[(order + 1) % len(images)]
    return Observation(previous=starts, current=starts, goals=goals)


def _context(seen: Observation, actions: int, number: int, memory: Sequences | None) -> PlanContext:
    tasks = len(seen.current)
    return PlanContext(
        observation=replace(seen, step=number),
        generators=tuple(np.random.default_rng([number, task]) for task in range(tasks)),
        blocked=np.zeros((tasks, actions), np.bool_),
        memory=memory,
    )
