"""Gradient descent on continuous actions, through a differentiable model and a differentiable objective.

Some sequences are drawn, and Adam (Kingma & Ba 2015) moves each downhill; after every step the actions are clipped to
their bounds. Objectives that look for objects in whole pixel values have no gradient: ``pixel`` and ``feature`` have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.errors import InvalidSetting, PlannerContractBroken
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Ranked, best_first
from dmotion_bench.planning.solvers.proposals import require_continuous, shifted
from dmotion_bench.planning.solvers.rollouts import Rollouts
from dmotion_bench.planning.solvers.search import known_costs
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class GradientDescent:
    """Adam on several sequences of each task.

    Attributes:
        samples: Sequences that are moved.
        horizon: Actions in a sequence.
        iterations: Steps of Adam.
        learning_rate: Of Adam, for actions in [-1, 1].
    """

    samples: int = 8
    horizon: int = 5
    iterations: int = 20
    learning_rate: float = 0.1

    def __post_init__(self) -> None:
        require_bounds(self, from_one=("samples", "horizon", "iterations"), above_zero=("learning_rate",))

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """The first action of the cheapest sequence that was met on the way; it costs the minimum over its steps.

        Raises:
            InvalidSetting: The actions are discrete, or the model or the objective has no gradient.
            PlannerContractBroken: A cost is NaN, or the gradient of a finite one is not finite.
        """
        tasks, width = len(context.generators), require_continuous(dynamics.actions, "gradient").width
        rollouts = Rollouts(dynamics, evaluator, context.observation, gradients=True)
        shape = (self.samples, self.horizon, width)
        start = np.stack([generator.uniform(-1, 1, shape) for generator in context.generators])
        if context.memory is not None:
            start[:, :1] = shifted(context.memory)
        rows = torch.arange(tasks).repeat_interleave(self.samples)
        actions = torch.from_numpy(start).float().flatten(0, 1).to(dynamics.device).requires_grad_()
        adam = torch.optim.Adam([actions], lr=self.learning_rate)
        found: Ranked | None = None
        progress = []
        for step in range(self.iterations + 1):
            with dynamics.computing(gradients=True):
                lowest = rollouts.predict(rows, actions)[..., 0].amin(dim=1)
            if not lowest.requires_grad:
                raise InvalidSetting(
                    "the planner 'gradient' needs a gradient of the cost, and this objective has none; "
                    "plan with '--objective pixel' or '--objective feature'."
                )
            now = actions.detach().cpu().double().numpy().reshape(tasks, *shape)
            costs = known_costs(lowest.detach().cpu().double().numpy().reshape(tasks, self.samples))
            found = best_first(now, costs, before=found)
            progress.append(found[1][:, 0])
            if step < self.iterations:
                (gradient,) = torch.autograd.grad(lowest.sum(), [actions])
                actions.grad = _known(gradient, lowest.detach())
                adam.step()
                with torch.no_grad():
                    actions.clamp_(-1, 1)
        assert found is not None, "there is an iteration"
        return rollouts.plan(*found, progress, memory=found[0][:, :1])


def _known(gradient: Float[Tensor, "n t a"], costs: Float[Tensor, " n"]) -> Float[Tensor, "n t a"]:
    """The gradient, zero for a sequence that has none because its cost is infinite.

    Raises:
        PlannerContractBroken: A finite cost has none.
    """
    without = ~torch.isfinite(gradient).flatten(1).all(dim=1)
    if bool((without & torch.isfinite(costs)).any()):
        raise PlannerContractBroken(
            "the gradient of the cost holds NaN or infinity, so the planner 'gradient' cannot follow it; plan with "
            "'icem' or 'mppi'."
        )
    return gradient.masked_fill(without[:, None, None], 0.0)
