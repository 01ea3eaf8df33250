"""The oracle's own objective: what the simulator's state costs, whatever is seen of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxtyping import Int
from torch import Tensor

from dmotion_bench.planning.dynamics.base import Dynamics, State
from dmotion_bench.planning.dynamics.simulator import SimulatorDynamics
from dmotion_bench.planning.objectives.base import CostState, Memoryless, StepCost


@dataclass(frozen=True, kw_only=True)
class TrueCost(Memoryless):
    """The states' true costs; as it remembers nothing, it is its own evaluator."""

    def reset(self, spec: Any, first: Any, goals: Any) -> TrueCost:
        """Nothing has to begin."""
        return self

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """What the simulator says."""
        assert isinstance(dynamics, SimulatorDynamics), "only the oracle's dynamics knows true costs"
        return StepCost.of(dynamics.true_costs(state)), ()
