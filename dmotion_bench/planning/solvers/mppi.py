"""Model predictive path integral control for continuous actions.

Williams et al. 2017, "Information Theoretic MPC for Model-Based Reinforcement Learning", ICRA: sequences are drawn
around a mean, which moves to their average, weighted by exp(-cost / temperature). Costs have units of their own here,
so the temperature is a share of the difference between the mean and the lowest cost. At the next step the mean is
shifted by one action. A sequence of infinite cost, which an objective forbids, has no weight.

Unlike there, a sequence costs what its cheapest step does, not the sum over its steps, and the mean itself is one of
the sequences in each iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Ranked, best_first
from dmotion_bench.planning.solvers.proposals import Gaussian, require_continuous, shifted
from dmotion_bench.planning.solvers.rollouts import Rollouts
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class PathIntegral:
    """MPPI.

    Attributes:
        samples: Sequences drawn an iteration.
        horizon: Actions in a sequence.
        iterations: How many times the mean moves before an action is taken.
        std: The noise's standard deviation, of actions in [-1, 1].
        noise_exponent: beta, by which the noise's power falls with frequency; 0 is white noise.
        temperature: The share of the difference between the mean and the lowest cost that lowers a weight by e.
    """

    samples: int = 50
    horizon: int = 5
    iterations: int = 4
    std: float = 0.5
    noise_exponent: float = 2.0
    temperature: float = 0.2

    def __post_init__(self) -> None:
        require_bounds(
            self,
            from_one=("samples", "horizon", "iterations"),
            above_zero=("std", "temperature"),
            from_zero=("noise_exponent",),
        )

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Move the mean ``iterations`` times, and take its first action.

        Raises:
            InvalidSetting: The actions are discrete.
        """
        shape = (len(context.generators), self.horizon, require_continuous(dynamics.actions, "mppi").width)
        rollouts = Rollouts(dynamics, evaluator, context.observation)
        mean = np.zeros(shape) if context.memory is None else shifted(context.memory)[:, 0]
        found: Ranked | None = None
        progress = []
        for _ in range(self.iterations):
            around = Gaussian(mean=mean, std=np.full(shape, self.std), exponent=self.noise_exponent, momentum=0.0)
            drawn = around.draw(context.generators, self.samples, temperature=0)
            costs = rollouts.costs(drawn).min(axis=2)
            moved = np.einsum("bs,bsta->bta", self._weights(costs), drawn)
            mean = np.where(np.isfinite(costs).any(axis=1)[:, None, None], moved, mean)
            found = best_first(drawn, costs, before=found)
            progress.append(found[1][:, 0])
        assert found is not None, "there is an iteration"
        return rollouts.plan(*found, progress, action=mean[:, 0], memory=mean[:, None])

    def _weights(self, costs: Float[np.ndarray, "b s"]) -> Float[np.ndarray, "b s"]:
        """The weight of each sequence, 0 of an infinite cost; they sum to one, or to zero where no cost is finite."""
        finite = np.isfinite(costs)
        lowest = costs.min(axis=1, keepdims=True, where=finite, initial=np.inf)
        above = np.subtract(costs, lowest, out=np.zeros_like(costs), where=finite)
        count = finite.sum(axis=1, keepdims=True)
        scale = self.temperature * (above.sum(axis=1, keepdims=True) / np.maximum(count, 1))
        weights = np.where(finite, np.exp(-above / np.where(scale > 0, scale, 1.0)), 0.0)
        normal: Float[np.ndarray, "b s"] = weights / np.where(count > 0, weights.sum(axis=1, keepdims=True), 1.0)
        return normal
