"""Tracked objects, and the risk that the next action makes one of them vanish for good.

Whether an object that fades is lost or hidden, ``tracked-risk`` asks once for a whole task: where one was ever seen in
part, it fears nothing any more. Here video has taught where things that vanish do not come back (``vanishing.py``), and
fading counts as much as that. Only images are used, and no label.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import CostState
from dmotion_bench.planning.objectives.centres import require_objects
from dmotion_bench.planning.objectives.tracked_risk import TrackedRisk, TrackedRiskEvaluator
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker
from dmotion_bench.planning.objectives.vanishing import Vanishings
from dmotion_bench.specs import EnvSpec
from dmotion_bench.storage.readable import ReadableDataset

EPISODES: Final = 500
"""Of the video, at most: the first ones that hold no task."""

_LEARNED: dict[tuple[str, TrackedVanishing], Vanishings] = {}
"""Of this process, by the data set's fingerprint: the agents of many groups of tasks share it."""


@dataclass(frozen=True, kw_only=True)
class TrackedVanishing(TrackedRisk):
    """The cost of tracked objects, and the expected cost of those that the first step may lose for good [px^2].

    Attributes:
        lost_below, safe_from: As for ``TrackedRisk``. In the video a thing has vanished if less than ``lost_below`` of
            it is left.
    """

    def learned(self, video: ReadableDataset) -> TaughtVanishing:
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
        return TaughtVanishing(settings=self, vanishings=_LEARNED[key])

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TrackedRiskEvaluator:
        """Nothing can be feared before video was seen.

        Raises:
            InvalidSetting: Always.
        """
        raise InvalidSetting("the objective 'tracked-vanishing' learns from video first; call its 'learned'.")


@dataclass(frozen=True, kw_only=True)
class TaughtVanishing:
    """The objective after it has seen video.

    Attributes:
        settings: Of the objective.
        vanishings: What the video showed.
    """

    settings: TrackedVanishing
    vanishings: Vanishings

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TrackedVanishingEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(spec)
        return TrackedVanishingEvaluator(
            spec, torch.from_numpy(first), torch.from_numpy(goals), self.settings, self.vanishings
        )


class TrackedVanishingEvaluator(TrackedRiskEvaluator):
    """Remembers what ``TrackedRiskEvaluator`` does, and what video showed.

    Args:
        spec, first, goals, settings: See ``TrackedEvaluator``.
        vanishings: What the video showed.
    """

    def __init__(
        self,
        spec: EnvSpec,
        first: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
        settings: TrackedVanishing,
        vanishings: Vanishings,
    ) -> None:
        super().__init__(spec, first, goals, settings)
        self._vanishings = vanishings

    def begin(self, dynamics: Dynamics) -> CostState:
        """What is carried is the risk; the chance at each object's place holds for the whole control step."""
        carried = super().begin(dynamics)
        self._chance = self._vanishings.chance(self._now.centre)
        return carried

    def _risk(self, now: BoundingBoxes, task: Int[Tensor, " n"]) -> Float[Tensor, "n k"]:
        """The risk that each object vanishes for good with the step from what is seen now to these frames."""
        return self._fading(now, task) * self._chance[task]
