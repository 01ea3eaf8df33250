"""The paper's objective with a memory: hidden objects stand where they were last seen (``tracking.py``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.dynamics.base import Dynamics, State, pixels_of
from dmotion_bench.planning.objectives.base import CostState, StepCost, Taken
from dmotion_bench.planning.objectives.centres import require_objects
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker
from dmotion_bench.specs import EnvSpec
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """Summed squared distances of the objects' centres, with each hidden object at its estimated place [px^2].

    It knows nothing of tables, arms or pushes. An object that is seen now and not in the prediction costs a fixed
    distance: it may have been lost.

    Attributes:
        fully_seen, box_margin_px: Of the tracker (``TrackingSettings``).
        lost_distance: What an object costs that may have been lost: this share of the frame's width, as a distance.
    """

    fully_seen: float = 0.85
    box_margin_px: float = 1.0
    lost_distance: float = 0.5
    finds_objects: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_bounds(self, from_zero=("fully_seen", "box_margin_px", "lost_distance"))

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TrackedEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(spec)
        return TrackedEvaluator(spec, torch.from_numpy(first), torch.from_numpy(goals), self)


class TrackedEvaluator:
    """Remembers where the objects of some tasks are.

    Args:
        spec: Says what the objects look like.
        first, goals: What is seen at the start, and what should be seen; what one hides is completed from the other.
        settings: Of the objective.
    """

    def __init__(
        self,
        spec: EnvSpec,
        first: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
        settings: Tracked,
    ) -> None:
        self._tracker, self._missing = Tracker(spec, settings), settings.lost_distance * spec.width
        self.known, self.wanted = self._tracker.meet(first, goals)

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """Update the estimated places."""
        self._see(self._tracker.look(torch.from_numpy(frames)))

    def _see(self, now: BoundingBoxes) -> None:
        """Update the estimated places after what real images show."""
        self.known = self._tracker.believed(self.known.to(torch.device("cpu")), now)

    def begin(self, dynamics: Dynamics) -> CostState:
        """Nothing is carried; the estimated places come to the dynamics' device."""
        self.known, self.wanted = self.known.to(dynamics.device), self.wanted.to(dynamics.device)
        return ()

    def of_boxes(self, now: BoundingBoxes, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of what images show."""
        return self.of_objects(now, task).sum(-1)

    def of_objects(self, now: BoundingBoxes, task: Int[Tensor, " n"]) -> Float[Tensor, "n k"]:
        """The cost of each object; none of one that the goal does not show."""
        known, missing = self.known.of(task), self._missing**2
        squared = (self._tracker.believed(known, now).centre - self.wanted.centre[task]).square().sum(-1)
        squared = squared.where(now.seen | ~known.seen, squared.new_tensor(missing))
        return torch.where(self.wanted.seen[task], squared.nan_to_num(missing), 0.0)

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The cost of the frames that the states look like."""
        return StepCost.of(self.of_boxes(self._tracker.look(pixels_of(dynamics, state)), task)), ()
