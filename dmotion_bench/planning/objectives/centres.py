"""The paper's objective (section III-C): squared distances of the objects' centres from those in the goal image.

The minimum over the horizon is the solver's business. An object that the goal shows and the prediction lacks costs a
fixed distance. The agent does not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics, State, pixels_of
from dmotion_bench.planning.objectives.base import CostState, Memoryless, StepCost
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import EnvSpec
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class Centres:
    """Summed squared distances of the objects' visible centres [px^2].

    Attributes:
        lost_distance: What a missing object costs: this share of the frame's width, as a distance.
    """

    lost_distance: float = 0.5
    finds_objects: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_bounds(self, from_zero=("lost_distance",))

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> CentresEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(spec)
        return CentresEvaluator(spec, torch.from_numpy(goals), self.lost_distance * spec.width)


class CentresEvaluator(Memoryless):
    """Finds the objects in each frame by itself.

    Args:
        spec: Says what the objects look like.
        goals: The goal image of each task.
        missing: The distance that an object costs which the goal shows and the prediction lacks [px].
    """

    def __init__(self, spec: EnvSpec, goals: UInt8[Tensor, "b h w 3"], missing: float) -> None:
        self._finder, self._objects, self._missing = PositionFinder(spec), len(spec.objects), missing
        wanted = self._finder.find(goals)
        self._centre, self._wanted = wanted.centre[:, : self._objects], wanted.found[:, : self._objects]

    def of_frames(self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of pictures."""
        seen = self._finder.find(frames)
        centre, found = seen.centre[:, : self._objects], seen.found[:, : self._objects]
        squared = (centre - self._centre.to(centre.device)[task]).square().sum(-1)
        squared = squared.where(found, squared.new_tensor(self._missing**2))
        return torch.where(self._wanted.to(centre.device)[task], squared, 0.0).sum(-1)

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The cost of the frames that the states look like."""
        return StepCost.of(self.of_frames(pixels_of(dynamics, state), task)), ()


def require_objects(spec: EnvSpec) -> None:
    """Check that there are objects to find.

    Raises:
        InvalidSetting: There are none.
    """
    if not spec.objects:
        raise InvalidSetting(f"{spec.id!r} has no coloured objects to find; plan with another '--objective'.")
