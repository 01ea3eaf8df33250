"""Tracked objects in imagined images, too: what is not seen there is believed to be where it was imagined last.

``tracked`` holds each imagined image against what real images have shown, and an object that it does not show costs a
fixed distance. So it refuses every plan that ends with the agent in front of an object. Here an imagined image updates
the belief just as a real one does (``tracking.py``). An object that is seen no longer is hidden or lost: lost with the
chance that things that vanish there do not come back, which video has shown (``vanishing.py``). If it is imagined again
it is hardly lost; but models draw traces of what is lost, too. One that is lost costs as much as all objects together
at the start, as in the distance that control is judged by (``planning/tasks.py``). Only images are used, and no label.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Final

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics, State, pixels_of
from dmotion_bench.planning.objectives.base import CostState, StepCost, Taken
from dmotion_bench.planning.objectives.centres import require_objects
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker
from dmotion_bench.planning.objectives.vanishing import Vanishings
from dmotion_bench.specs import EnvSpec
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.values import require_bounds

EPISODES: Final = 500
"""Of the video, at most: the first ones that hold no task."""

_LEARNED: dict[tuple[str, TrackedBelief], Vanishings] = {}
"""Of this process, by the data set's fingerprint: the agents of many groups of tasks share it."""


@dataclass(frozen=True, kw_only=True)
class TrackedBelief:
    """Summed squared distances of the objects' believed centres, and the expected cost of those that are lost [px^2].

    Attributes:
        fully_seen, box_margin_px: Of the tracker (``TrackingSettings``).
        lost_below: In the video a thing has vanished if less than this share of it is left from one frame to the next.
        drawn_again: How likely a model draws a lost object again, where it would draw one that was only hidden.
    """

    fully_seen: float = 0.85
    box_margin_px: float = 1.0
    lost_below: float = 0.15
    drawn_again: float = 0.05
    finds_objects: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_bounds(self, from_zero=("fully_seen", "box_margin_px", "lost_below", "drawn_again"))

    def learned(self, video: ReadableDataset) -> TaughtBelief:
        """Learn from the video of a data set's episodes that hold no task; its labels are not read.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(video.spec)
        key = (video.fingerprint, self)
        if key not in _LEARNED:
            busy = {task.episode for task in video.tasks()}
            free = [episode for episode in range(len(video)) if episode not in busy][:EPISODES]
            seen = (torch.from_numpy(np.array(video.video(episode))) for episode in free)
            _LEARNED[key] = Vanishings.seen_in(seen, Tracker(video.spec, self), self.lost_below)
        return TaughtBelief(settings=self, vanishings=_LEARNED[key])

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TrackedBeliefEvaluator:
        """Nothing can be feared before video was seen.

        Raises:
            InvalidSetting: Always.
        """
        raise InvalidSetting("the objective 'tracked-belief' learns from video first; call its 'learned'.")


@dataclass(frozen=True, kw_only=True)
class TaughtBelief:
    """The objective after it has seen video.

    Attributes:
        settings: Of the objective.
        vanishings: What the video showed.
    """

    settings: TrackedBelief
    vanishings: Vanishings

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TrackedBeliefEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(spec)
        return TrackedBeliefEvaluator(
            spec, self.settings, torch.from_numpy(first), torch.from_numpy(goals), self.vanishings
        )


class TrackedBeliefEvaluator:
    """Remembers where the objects of some tasks are.

    Args:
        spec: Says what the objects look like.
        settings: Of the objective.
        first, goals: What is seen at the start, and what should be seen; what one hides is completed from the other.
        vanishings: What video showed.

    Attributes:
        known, wanted: Where they are, and where they should be.
    """

    def __init__(
        self,
        spec: EnvSpec,
        settings: TrackedBelief,
        first: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
        vanishings: Vanishings,
    ) -> None:
        self._tracker, self._settings, self._vanishings = Tracker(spec, settings), settings, vanishings
        self.known, self.wanted = self._tracker.meet(first, goals)
        off = (self.known.centre - self.wanted.centre).norm(dim=-1).nan_to_num(0.0)
        self._price = torch.where(self.wanted.seen, off, 0.0).sum(1).square()

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """Update the believed places after what real images show."""
        self.known = self._tracker.update(self.known.to(torch.device("cpu")), torch.from_numpy(frames))

    def begin(self, dynamics: Dynamics) -> CostState:
        """What is believed is carried, and the chance that each object was lost on the way; all on one device."""
        device = dynamics.device
        self.known, self.wanted, self._price = self.known.to(device), self.wanted.to(device), self._price.to(device)
        return (*_fields(self.known), torch.zeros_like(self.known.centre[..., 0]))

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The cost of what is believed after the frames that the states look like."""
        *believed, lost = cost_state
        before = BoundingBoxes(**dict(zip(_NAMES, believed, strict=True)))
        after = self._tracker.believed(before, self._tracker.look(pixels_of(dynamics, state)))
        vanished = torch.maximum(lost, self._vanishings.chance(before.centre))
        again = lost * self._settings.drawn_again / (lost * self._settings.drawn_again + 1 - lost).clamp(min=1e-9)
        lost = torch.where(before.seen == after.seen, lost, torch.where(after.seen, again, vanished))
        distance, risk = self._each(after, lost, task)
        cost = StepCost(distance=distance, risk=risk, bonus=torch.zeros_like(distance), total=distance + risk)
        return cost, (*_fields(after), lost)

    def _each(
        self, after: BoundingBoxes, lost: Float[Tensor, "n k"], task: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """The squared distances, summed over the objects, and what is added for those that may be lost."""
        sought, price = self.wanted.seen[task], self._price[task, None]
        squared = (after.centre - self.wanted.centre[task]).square().sum(-1)
        squared = torch.where(sought, squared.where(~squared.isnan(), price), 0.0)
        more = torch.where(sought, (price - squared).clamp(min=0) * lost, 0.0)
        return squared.sum(-1), more.sum(-1)


_NAMES: Final = tuple(one.name for one in fields(BoundingBoxes))


def _fields(boxes: BoundingBoxes) -> tuple[Tensor, ...]:
    return tuple(getattr(boxes, name) for name in _NAMES)
