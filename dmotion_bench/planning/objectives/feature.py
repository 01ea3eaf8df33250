"""The difference of states, for models that draw no frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.planning.dynamics.base import Dynamics, Observation, State
from dmotion_bench.planning.objectives.base import CostState, Memoryless, StepCost
from dmotion_bench.specs import EnvSpec


@dataclass(frozen=True, kw_only=True)
class Feature:
    """Mean squared difference between the features of a state and of the goal image, given twice; the agent counts."""

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> FeatureEvaluator:
        """Begin some tasks."""
        return FeatureEvaluator(goals)


class FeatureEvaluator(Memoryless):
    """Compares features with those of the goals."""

    def __init__(self, goals: UInt8[np.ndarray, "b h w 3"]) -> None:
        self._goals = goals
        self._wanted: Float[Tensor, "b d"] | None = None

    def begin(self, dynamics: Dynamics) -> CostState:
        """Nothing is carried; the goals' features are computed at the first step, for they do not change.

        Raises:
            ModelContractBroken: They hold NaN or infinity, so no state could be compared with them.
        """
        if self._wanted is None:
            seen = Observation(previous=self._goals, current=self._goals, goals=self._goals)
            wanted = dynamics.features(dynamics.start(seen))
            if not bool(torch.isfinite(wanted).all()):
                raise ModelContractBroken(
                    "the model's features of the goal image hold NaN or infinity; its training diverged."
                )
            self._wanted = wanted
        return ()

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The difference of each state's features."""
        assert self._wanted is not None, "begin comes first"
        return StepCost.of((dynamics.features(state) - self._wanted[task]).square().mean(1)), ()
