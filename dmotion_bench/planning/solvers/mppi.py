"""Model predictive path integral control for continuous actions.

Williams et al. 2017, "Information Theoretic MPC for Model-Based Reinforcement Learning", ICRA: sequences are drawn
around a mean, which moves to their average, weighted by exp(-cost / temperature). Costs have units of their own here,
so the temperature is a share of the difference between the mean and the lowest cost. At the next step the mean is
shifted by one action.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.dynamics.rollouts import Rollouts
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import SHOWN, Plan, PlanContext, best_first
from dmotion_bench.planning.solvers.proposals import Gaussian, require_continuous, shifted


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
        for name in ("samples", "horizon", "iterations"):
            if getattr(self, name) < 1:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be 1 or more.")
        for name in ("std", "temperature"):
            if getattr(self, name) <= 0:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be above zero.")
        if self.noise_exponent < 0:
            raise InvalidSetting(f"noise_exponent is {self.noise_exponent}; it cannot be below zero.")

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Move the mean ``iterations`` times, and take its first action.

        Raises:
            InvalidSetting: The actions are discrete.
        """
        shape = (len(context.generators), self.horizon, require_continuous(dynamics.actions, "mppi").width)
        rollouts = Rollouts(dynamics, evaluator, context.observation)
        mean = np.zeros(shape) if context.memory is None else shifted(context.memory)[:, 0]
        best, price = np.zeros((shape[0], 0, *shape[1:])), np.zeros((shape[0], 0))
        progress = []
        for _ in range(self.iterations):
            around = Gaussian(mean=mean, std=np.full(shape, self.std), exponent=self.noise_exponent, momentum=0.0)
            drawn = around.draw(context.generators, self.samples, heat=0)
            costs = rollouts.costs(drawn).min(axis=2)
            mean = np.einsum("bs,bsta->bta", self._weights(costs), drawn)
            best, price = best_first(
                np.concatenate([best, drawn], axis=1), np.concatenate([price, costs], axis=1), SHOWN
            )
            progress.append(price[:, 0])
        return Plan(
            action=mean[:, 0],
            candidates=best,
            costs=price,
            parts=rollouts.parts(best, rollouts.costs(best).argmin(axis=2)),
            progress=np.stack(progress, axis=1),
            frames=rollouts.frames,
            memory=mean[:, None],
        )

    def _weights(self, costs: Float[np.ndarray, "b s"]) -> Float[np.ndarray, "b s"]:
        """The weight of each sequence; they sum to one."""
        above = costs - costs.min(axis=1, keepdims=True)
        scale = self.temperature * above.mean(axis=1, keepdims=True)
        weights = np.exp(-above / np.where(scale > 0, scale, 1.0))
        normal: Float[np.ndarray, "b s"] = weights / weights.sum(axis=1, keepdims=True)
        return normal
