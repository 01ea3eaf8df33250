"""How many control steps a second a model allows, with everything this package does for speed and without.

Two ways of doing the same work, one control step of the paper's CEM with the same candidates:

- *together*: a tree of futures, tasks side by side, one batch of frames after the other;
- *one by one*: every candidate of every iteration imagined by itself, frame after frame, nothing shared.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8

from dmotion_bench.actions import require_discrete
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.control import GROUP
from dmotion_bench.planning.controllers import Decision, ModelController, Seen
from dmotion_bench.planning.cross_entropy import CrossEntropyPlanner
from dmotion_bench.planning.futures import ModelFutures
from dmotion_bench.specs import EnvSpec

PAPERS = CrossEntropyPlanner()


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
        self._controller = ModelController(model, spec, PAPERS, device=device)
        self._images, self._tasks, self._actions, self._number = (
            images,
            tasks,
            len(require_discrete(spec.actions, "planning")),
            0,
        )
        plan = self._act().plan
        self.frames_per_step = plan.frames / tasks if plan else 0.0

    def __call__(self) -> float:
        """Take the step; how many it was, one of each task."""
        self._act()
        return self._tasks

    def _act(self) -> Decision:
        self._number += 1
        return self._controller.act(_seen(self._images, self._tasks, self._actions, self._number))


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
        controller = ModelController(model, spec, PAPERS, device=device)
        self._futures = controller.futures(_seen(images, 1, len(require_discrete(spec.actions, "planning")), 0))
        drawn = np.random.default_rng(0).integers(
            0, len(require_discrete(spec.actions, "planning")), (1000, PAPERS.horizon)
        )
        self._candidates = itertools.cycle(drawn)
        self.frames_per_step = float(PAPERS.samples * PAPERS.iterations * PAPERS.horizon)

    def __call__(self) -> float:
        """Imagine the next candidate; the part of a control step that it is."""
        rollout_costs(self._futures, next(self._candidates))
        return 1 / (PAPERS.samples * PAPERS.iterations)


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
