"""The difference of pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from dmotion_bench.learning.images import to_model
from dmotion_bench.planning.dynamics.base import Dynamics, State
from dmotion_bench.planning.objectives.base import CostState, Memoryless, StepCost
from dmotion_bench.specs import EnvSpec


@dataclass(frozen=True, kw_only=True)
class Pixel:
    """Mean squared difference between the predicted frame and the goal image, in [-1, 1] units; the agent counts."""

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> PixelEvaluator:
        """Begin some tasks."""
        return PixelEvaluator(goals)


class PixelEvaluator(Memoryless):
    """Compares frames with the goals."""

    def __init__(self, goals: UInt8[np.ndarray, "b h w 3"]) -> None:
        self._goals = to_model(torch.from_numpy(goals))

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The difference of each state's frame."""
        goals = self._goals.to(dynamics.device)[task]
        return StepCost.of((dynamics.frames(state).float() - goals).square().flatten(1).mean(1)), ()
