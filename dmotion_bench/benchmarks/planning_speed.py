"""How many control steps a second a model allows, with everything this package does for speed and without.

Two ways of doing the same work, one control step of the paper's CEM with the same candidates:

- *together*: a tree of predictions, tasks side by side, one batch of frames after the other;
- *one by one*: every candidate of every iteration predicted by itself, frame after frame, nothing shared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8

from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import ModelAgent
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


@dataclass(frozen=True, kw_only=True)
class PlanningSpeed:
    """What was measured.

    Attributes:
        steps: Control steps, each of one task; a fraction where less than a whole one was measured.
        frames: Predicted for them.
        seconds: By the clock.
        cpu_seconds: Of this process.
    """

    steps: float
    frames: int
    seconds: float
    cpu_seconds: float

    @property
    def steps_per_s(self) -> float:
        """Control steps per second of elapsed time."""
        return self.steps / self.seconds

    @property
    def steps_per_cpu_s(self) -> float:
        """Control steps per second of processor time, which other programs do not disturb."""
        return self.steps / self.cpu_seconds

    @property
    def frames_per_s(self) -> float:
        """Frames per second that are predicted, decoded and searched for objects."""
        return self.frames / self.seconds


def measure_planning(
    model: ForwardModel[Any],
    spec: EnvSpec,
    images: UInt8[np.ndarray, "n h w 3"],
    seconds: float = 5.0,
    *,
    tasks: int = GROUP,
    device: torch.device | None = None,
) -> PlanningSpeed:
    """Control steps of several tasks side by side, as the control loop takes them.

    Args:
        model: Aligned or not: the work is the same.
        spec: What the objects look like.
        images: Starts and goals of the tasks; at least two.
        seconds: How long to measure, after one step that warms up.
        tasks: Side by side.
        device: Where the model runs.
    """
    agent = ModelAgent(model, spec, PAPERS, _objective(model), device=device)
    seen = _observation(images, tasks)
    agent.reset(seen.current, seen.goals)
    frames = 0

    def step(number: int) -> None:
        nonlocal frames
        decision = agent.act(_context(seen, len(spec.actions), number))
        frames += decision.plan.frames if decision.plan else 0

    step(0)
    frames = 0
    count, clock, cpu = _repeat(step, seconds)
    return PlanningSpeed(steps=count * tasks, frames=frames, seconds=clock, cpu_seconds=cpu)


def measure_one_by_one(
    model: ForwardModel[Any],
    spec: EnvSpec,
    images: UInt8[np.ndarray, "n h w 3"],
    seconds: float = 5.0,
    *,
    device: torch.device | None = None,
) -> PlanningSpeed:
    """The same candidates, predicted one at a time with nothing shared; arguments as in ``measure_planning``."""
    dynamics = ModelDynamics(model.to(device or torch.device("cpu")).eval(), device=device)
    seen = _observation(images, 1)
    evaluator = _objective(model).reset(spec, seen.current, seen.goals)
    candidates = np.random.default_rng(0).integers(0, len(spec.actions), (1000, PAPERS.horizon))

    def candidate(number: int) -> None:
        rollout_costs(dynamics, evaluator, seen, candidates[number % len(candidates)])

    candidate(0)
    count, clock, cpu = _repeat(candidate, seconds)
    steps = count / (PAPERS.samples * PAPERS.iterations)
    return PlanningSpeed(steps=steps, frames=count * PAPERS.horizon, seconds=clock, cpu_seconds=cpu)


def rollout_costs(
    dynamics: ModelDynamics, evaluator: Evaluator, seen: Observation, actions: Int[np.ndarray, " t"]
) -> list[float]:
    """What a sequence of a task's costs, step by step, predicted by itself."""
    with torch.inference_mode():
        carried = evaluator.begin(dynamics)
    costs, task = [], torch.zeros(1, dtype=torch.long, device=dynamics.device)
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


def _repeat(work: Callable[[int], None], seconds: float) -> tuple[int, float, float]:
    """How often ``work`` was done in so many seconds, and how long that took by the clock and of the processor."""
    count, clock, cpu = 0, time.perf_counter(), time.process_time()
    while count == 0 or time.perf_counter() - clock < seconds:
        count += 1
        work(count)
    return count, time.perf_counter() - clock, time.process_time() - cpu
