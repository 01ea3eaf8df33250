"""Tracked objects, and the risk that the next action makes one of them disappear.

An object that fades in an imagined frame is blurred, hidden, or about to be lost. ``tracked`` believes it in its place
whatever it is, so a planner is not warned of a loss that the model draws. Two things tell them apart
(``docs/experiments/generic-planner.md``), and neither knows of tables or falls. Only images are used.

- Blurred: the first imagined frame starts from real images and is sharp. Of an object that is moved and kept, most is
  still there. Later frames are blurred wherever anything moves, and are not asked.
- Hidden: where something hides objects, real images show parts of them sooner or later. A task in which one was seen
  in part has no risk from then on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics, State, pixels_of
from dmotion_bench.planning.objectives.base import CostState, StepCost
from dmotion_bench.planning.objectives.centres import require_objects
from dmotion_bench.planning.objectives.tracked import Tracked, TrackedEvaluator
from dmotion_bench.planning.objectives.tracking import BoundingBoxes
from dmotion_bench.specs import EnvSpec
from dmotion_bench.values import require_bounds

UNKNOWN = -1.0
"""The risk before the first imagined frame."""


@dataclass(frozen=True, kw_only=True)
class TrackedRisk(Tracked):
    """The cost of tracked objects, and the expected cost of those that the first step may lose [px^2].

    Attributes:
        lost_below: An object of which less than this share is left, of what is seen of it now, is lost.
        safe_from: From this share on it is not; between the two the risk falls evenly.
    """

    lost_below: float = 0.15
    safe_from: float = 0.6

    def __post_init__(self) -> None:
        super().__post_init__()
        require_bounds(self, from_zero=("lost_below", "safe_from"))
        if not self.lost_below < self.safe_from:
            raise InvalidSetting(
                f"lost_below is {self.lost_below} and safe_from {self.safe_from}; the first must be less."
            )

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TrackedRiskEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(spec)
        return TrackedRiskEvaluator(spec, torch.from_numpy(first), torch.from_numpy(goals), self)


class TrackedRiskEvaluator(TrackedEvaluator):
    """Remembers where the objects of some tasks are, what is seen of them now, and whether any was seen in part.

    Args:
        spec, first, goals, settings: See ``TrackedEvaluator``.
    """

    def __init__(
        self,
        spec: EnvSpec,
        first: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
        settings: TrackedRisk,
    ) -> None:
        super().__init__(spec, first, goals, settings)
        self._settings, self._now = settings, self._tracker.look(first)
        self._clear = ~self._in_part(self._now) & ~self._in_part(self._tracker.look(goals))

    def begin(self, dynamics: Dynamics) -> CostState:
        """The risk of each object is carried; it is not known yet."""
        super().begin(dynamics)
        self._now, self._clear = self._now.to(dynamics.device), self._clear.to(dynamics.device)
        return (self._now.centre.new_full(self._now.seen.shape, UNKNOWN),)

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The cost of the frames that the states look like, with the risk of the first of them."""
        now, (risk,) = self._tracker.look(pixels_of(dynamics, state)), cost_state
        risk = torch.where(risk == UNKNOWN, self._risk(now, task), risk)
        each = self.of_objects(now, task)
        more = torch.where(self.wanted.seen[task], (self._missing**2 - each).clamp(min=0) * risk, 0.0)
        distance, feared = each.sum(-1), more.sum(-1)
        cost = StepCost(distance=distance, risk=feared, bonus=torch.zeros_like(distance), total=distance + feared)
        return cost, (risk,)

    def _see(self, now: BoundingBoxes) -> None:
        super()._see(now)
        self._now, self._clear = now, self._clear.cpu() & ~self._in_part(now)

    def _in_part(self, shown: BoundingBoxes) -> Bool[Tensor, " b"]:
        """Whether a real image shows an object in part; a lost one is not shown at all."""
        return (shown.seen & (shown.pixels < self._settings.safe_from * self.known.pixels.cpu())).any(1)

    def _risk(self, now: BoundingBoxes, task: Int[Tensor, " n"]) -> Float[Tensor, "n k"]:
        """The risk that each object is lost with the step from what is seen now to these frames."""
        return self._fading(now, task) * self._clear[task, None]

    def _fading(self, now: BoundingBoxes, task: Int[Tensor, " n"]) -> Float[Tensor, "n k"]:
        """How far each object that is seen now fades in these frames: 0 if it stays, 1 if it is no longer there."""
        own, before = self._settings, self._now.of(task)
        left = now.pixels / before.pixels.clamp(min=1)
        faded = ((own.safe_from - left) / (own.safe_from - own.lost_below)).clamp(0, 1)
        return faded * before.seen
