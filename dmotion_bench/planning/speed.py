"""How many control steps a second a model allows, with everything this package does for speed and without.

Two ways of doing the same work, one control step of the paper's CEM with the same candidates:

- *together*: a tree of futures, tasks side by side, one batch of frames after the other;
- *one by one*: every candidate of every iteration imagined by itself, frame after frame, nothing shared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8

from dmotion_bench.actions import require_discrete
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.control import GROUP
from dmotion_bench.planning.controllers import ModelController, Seen
from dmotion_bench.planning.cross_entropy import CrossEntropyPlanner
from dmotion_bench.planning.futures import ModelFutures
from dmotion_bench.specs import EnvSpec

PAPERS = CrossEntropyPlanner()


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
    controller = ModelController(model, spec, PAPERS, device=device)
    frames = 0

    def step(number: int) -> None:
        nonlocal frames
        decision = controller.act(_seen(images, tasks, len(require_discrete(spec.actions, "planning")), number))
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
    """The same candidates, imagined one at a time with nothing shared; arguments as in ``measure_planning``."""
    controller = ModelController(model, spec, PAPERS, device=device)
    futures = controller.futures(_seen(images, 1, len(require_discrete(spec.actions, "planning")), 0))
    candidates = np.random.default_rng(0).integers(
        0, len(require_discrete(spec.actions, "planning")), (1000, PAPERS.horizon)
    )

    def candidate(number: int) -> None:
        rollout_costs(futures, candidates[number % len(candidates)])

    candidate(0)
    count, clock, cpu = _repeat(candidate, seconds)
    steps = count / (PAPERS.samples * PAPERS.iterations)
    return PlanningSpeed(steps=steps, frames=count * PAPERS.horizon, seconds=clock, cpu_seconds=cpu)


def rollout_costs(futures: ModelFutures, actions: Int[np.ndarray, " t"]) -> list[float]:
    """What a sequence of the first task's costs, step by step, imagined by itself."""
    state, costs = tuple(part[:1] for part in futures.begin()), []
    for action in actions.tolist():
        state, cost = futures.expand(state, torch.zeros(1, dtype=torch.long), torch.tensor([action]))
        costs.append(float(cost))
    return costs


def _seen(images: UInt8[np.ndarray, "n h w 3"], tasks: int, actions: int, number: int) -> Seen:
    order = np.arange(tasks)
    starts, goals = images[order % len(images)], images[(order + 1) % len(images)]
    return Seen(
        previous=starts,
        current=starts,
        goals=goals,
        step=number,
        blocked=np.zeros((tasks, actions), np.bool_),
        generators=tuple(np.random.default_rng([number, task]) for task in range(tasks)),
    )


def _repeat(work: Callable[[int], None], seconds: float) -> tuple[int, float, float]:
    """How often ``work`` was done in so many seconds, and how long that took by the clock and of the processor."""
    count, clock, cpu = 0, time.perf_counter(), time.process_time()
    while count == 0 or time.perf_counter() - clock < seconds:
        count += 1
        work(count)
    return count, time.perf_counter() - clock, time.process_time() - cpu
