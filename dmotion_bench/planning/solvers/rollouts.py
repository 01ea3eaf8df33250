"""Predictions of sequences of continuous actions: no two begin alike, so only whole repetitions are shared."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.planning.dynamics.base import Dynamics, Observation
from dmotion_bench.planning.objectives.base import PARTS, Evaluator


class Rollouts:
    """Predicts sequences for some tasks from one control step on, and remembers what they cost.

    Args:
        dynamics: Predicts the states.
        evaluator: Says what they cost.
        observation: Of the tasks, now.
        gradients: Whether ``predict`` is to give gradients.

    Attributes:
        frames: How many states have been predicted.
    """

    def __init__(
        self, dynamics: Dynamics, evaluator: Evaluator, observation: Observation, *, gradients: bool = False
    ) -> None:
        self._dynamics, self._evaluator, self.frames = dynamics, evaluator, 0
        with torch.no_grad() if gradients else torch.inference_mode():
            self._carried = evaluator.begin(dynamics)
        with dynamics.computing(gradients=gradients):
            self._start = dynamics.start(observation)
        self._known: dict[tuple[int, bytes], Float[np.ndarray, "t 4"]] = {}

    def costs(self, sequences: Float[np.ndarray, "b s t a"]) -> Float[np.ndarray, "b s t"]:
        """The cost of each sequence of each task after each of its steps; actions are in [-1, 1]."""
        return self._costs(sequences)[..., 0]

    def parts(
        self, sequences: Float[np.ndarray, "b s t a"], step: Int[np.ndarray, "b s"]
    ) -> Mapping[str, Float[np.ndarray, "b s"]]:
        """The parts of the cost of each sequence at one of its steps."""
        costs = np.take_along_axis(self._costs(sequences), step[..., None, None], axis=2)[:, :, 0]
        return {name: costs[..., 1 + place] for place, name in enumerate(PARTS)}

    def _costs(self, sequences: Float[np.ndarray, "b s t a"]) -> Float[np.ndarray, "b s t 4"]:
        names = [[(task, one.tobytes()) for one in own] for task, own in enumerate(sequences)]
        new = {
            name: (task, one)
            for task, own in enumerate(sequences)
            for name, one in zip(names[task], own, strict=True)
            if name not in self._known
        }
        rows = list(new.items())
        for first in range(0, len(rows), self._dynamics.at_once):
            part = rows[first : first + self._dynamics.at_once]
            task = torch.tensor([task for _, (task, _) in part])
            with self._dynamics.computing():
                actions = torch.from_numpy(np.stack([one for _, (_, one) in part])).float()
                found = self.predict(task, actions).cpu().double().numpy()
            self._known |= {name: costs for (name, _), costs in zip(part, found, strict=True)}
        return np.array([[self._known[name] for name in own] for own in names])

    def predict(self, task: Int[Tensor, " n"], actions: Float[Tensor, "n t a"]) -> Float[Tensor, "n t 4"]:
        """The costs of sequences and their parts, within ``dynamics.computing()``; gradients reach the actions."""
        dynamics = self._dynamics
        task, actions = task.to(dynamics.device), actions.to(dynamics.device)
        state, carried = (tuple(one[task] for one in parts) for parts in (self._start, self._carried))
        costs = []
        for action in actions.unbind(1):
            state = dynamics.step(state, action)
            cost, carried = self._evaluator.step(dynamics, state, task, action, carried)
            costs.append(cost.stacked())
        self.frames += actions.shape[0] * actions.shape[1]
        return torch.stack(costs, dim=1)
