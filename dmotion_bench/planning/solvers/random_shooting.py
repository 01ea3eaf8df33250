"""Random shooting: the best of many sequences that are drawn once, all with the same probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dmotion_bench.actions import Discrete
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Sequences, best_first
from dmotion_bench.planning.solvers.proposals import Categorical, search
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class RandomShooting:
    """Draws sequences of any kind of action, and takes the first action of the cheapest.

    Attributes:
        samples: Sequences drawn.
        horizon: Actions in a sequence.
    """

    samples: int = 200
    horizon: int = 5

    def __post_init__(self) -> None:
        require_bounds(self, from_one=("samples", "horizon"))

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """The cheapest sequence of those drawn; a sequence costs the minimum over its steps."""
        sought = search(dynamics, evaluator, context.observation, self.horizon)
        drawn = self._drawn(dynamics, context)
        best, costs = best_first(drawn, sought.costs(drawn).min(axis=2))
        return sought.plan(best, costs, [costs[:, 0]])

    def _drawn(self, dynamics: Dynamics, context: PlanContext) -> Sequences:
        actions = dynamics.actions
        if isinstance(actions, Discrete):
            uniform = Categorical.uniform(len(actions), context.blocked, self.horizon, repeat=0.0)
            return uniform.draw(context.generators, self.samples)
        shape = (self.samples, self.horizon, actions.width)
        return np.stack([generator.uniform(-1, 1, shape) for generator in context.generators])
