"""Predictions of sequences of continuous actions.

No two begin alike, so only whole repetitions are shared, and what a model can say of a task's state before it knows the
first action.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import InvalidSetting, PlannerContractBroken
from dmotion_bench.planning.dynamics.base import Dynamics, Observation, branched
from dmotion_bench.planning.objectives.base import PARTS, Evaluator
from dmotion_bench.planning.solvers.base import are_within
from dmotion_bench.planning.solvers.search import Search, require_sequences


class Rollouts(Search):
    """Predicts sequences for some tasks from one control step on, and remembers what they cost.

    Args:
        dynamics: Predicts the states.
        evaluator: Says what they cost.
        observation: Of the tasks, now.
        gradients: Whether ``predict`` is to give gradients.

    Raises:
        InvalidSetting: The actions are discrete.
    """

    def __init__(
        self, dynamics: Dynamics, evaluator: Evaluator, observation: Observation, *, gradients: bool = False
    ) -> None:
        if not isinstance(dynamics.actions, Continuous):
            raise InvalidSetting(
                f"the solver predicts continuous actions, and these are discrete: {dynamics.actions}; take a data set "
                "with continuous actions, or another solver: '--planner icem'."
            )
        self._dynamics, self._evaluator, self.frames = dynamics, evaluator, 0
        self._tasks = len(observation.current)
        with torch.no_grad() if gradients else torch.inference_mode():
            self._carried = evaluator.begin(dynamics)
        with dynamics.computing(gradients=gradients):
            self._start = dynamics.start(observation)
        self._known: dict[tuple[int, bytes], Float[np.ndarray, "t 4"]] = {}

    def stacked_costs(self, sequences: Any) -> Float[np.ndarray, "b s t 4"]:
        """See ``Search``."""
        require_sequences(sequences, self._dynamics.actions, self._tasks)
        if not are_within(sequences):
            tried = f"{sequences.min():.6g} to {sequences.max():.6g}"
            raise PlannerContractBroken(f"the solver tries the actions {tried}; there are -1 to 1.")
        names = [(task, one.tobytes()) for task, own in enumerate(sequences) for one in own]
        given = dict(zip(names, sequences.reshape(-1, *sequences.shape[2:]), strict=True))
        new = [name for name in given if name not in self._known]
        with self._dynamics.computing():  # once for all, so that autocast keeps the weights that it has rounded
            for first in range(0, len(new), self._dynamics.at_once):
                part = new[first : first + self._dynamics.at_once]
                actions = torch.from_numpy(np.stack([given[name] for name in part])).float()
                found = self.predict(torch.tensor([task for task, _ in part]), actions)
                self._known |= dict(zip(part, found.cpu().double().numpy(), strict=True))
        return np.array([self._known[name] for name in names]).reshape(*sequences.shape[:3], 1 + len(PARTS))

    def predict(self, task: Int[Tensor, " n"], actions: Float[Tensor, "n t a"]) -> Float[Tensor, "n t 4"]:
        """The costs of sequences and their parts, within ``dynamics.computing()``; gradients reach the actions."""
        dynamics = self._dynamics
        task, actions = task.to(dynamics.device), actions.to(dynamics.device)
        carried = tuple(one[task] for one in self._carried)
        state, costs = self._start, list[Tensor]()
        for number, action in enumerate(actions.unbind(1)):
            state = dynamics.step(state, action) if number else branched(dynamics, state, task, action)
            cost, carried = self._evaluator.step(dynamics, state, task, action, carried)
            costs.append(cost.stacked())
        self.frames += actions.shape[0] * actions.shape[1]
        return torch.stack(costs, dim=1)
