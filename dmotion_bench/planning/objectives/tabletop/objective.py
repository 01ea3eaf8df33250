"""The objective for objects on a table that an arm pushes, seen by a camera that looks down on them.

It puts together what this package knows: where objects are (``tracking.py``), what hides them (``occlusion.py``),
where they are in predicted frames (``followed.py``), which may fall (``falls.py``), and where the agent goes while no
push is within reach (``exploration.py``, ``push_pose.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.planning.dynamics.base import Actions, Dynamics, State, pixels_of
from dmotion_bench.planning.objectives.base import CostState, StepCost, Taken
from dmotion_bench.planning.objectives.centres import require_objects
from dmotion_bench.planning.objectives.tabletop.exploration import Exploration, History, misplaced
from dmotion_bench.planning.objectives.tabletop.falls import FallRisk
from dmotion_bench.planning.objectives.tabletop.followed import FollowedObjects
from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.push_pose import PushPoseBonus
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.planning.objectives.tabletop.table_area import TableArea
from dmotion_bench.planning.objectives.tracking import Tracker
from dmotion_bench.specs import EnvSpec


@dataclass(frozen=True, kw_only=True)
class Tabletop(TabletopSettings):
    """Followed objects, the risk that they fall, and bonuses for exploring; the fields are its whole configuration."""

    finds_objects: ClassVar[bool] = True

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> TabletopEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects.
        """
        require_objects(spec)
        return TabletopEvaluator(self, spec, torch.from_numpy(first), torch.from_numpy(goals))


class TabletopEvaluator:
    """Remembers where the objects of some tasks are, and all that was seen and done.

    Args:
        settings: See there.
        spec: Says what the objects look like.
        first, goals: What is seen at the start, and what should be seen; what one hides is completed from the other.
    """

    def __init__(
        self,
        settings: TabletopSettings,
        spec: EnvSpec,
        first: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
    ) -> None:
        self._settings, self._spec, self._current, self._goals = settings, spec, first, goals
        self._tracker = Tracker(spec, settings)
        self._known, self._wanted = self._tracker.meet(first, goals)
        self._history = History.first(first, settings.history_side_px, spec.actions or Discrete.numbered(1))
        self._objects: FollowedObjects | None = None

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """Update the estimated places and the history."""
        self._current = torch.from_numpy(frames)
        self._known = self._tracker.update(self._known, self._current)
        self._history = self._history.after(self._normal(actions), self._current)

    def _normal(self, actions: Taken) -> Actions:
        """Actions that were taken, as a dynamics takes them."""
        spec = self._spec.actions
        return torch.from_numpy(spec.normalise(actions) if isinstance(spec, Continuous) else actions).to(
            torch.float32 if isinstance(spec, Continuous) else torch.int64
        )

    def begin(self, dynamics: Dynamics) -> CostState:
        """What is known of the objects before the first predicted step."""
        self._objects = self.now(dynamics.device)
        return (self._objects.begin(),)

    def now(self, device: torch.device) -> FollowedObjects:
        """The cost from the present moment on."""
        settings, spec, tracker = self._settings, self._spec, self._tracker
        current, goals = self._current.to(device), self._goals.to(device)
        known, wanted = self._known.to(device), self._wanted.to(device)
        occlusion = OcclusionModel(settings, tracker, current, known)
        table = TableArea(settings, occlusion, current, goals)
        off = misplaced(settings, known, wanted, occlusion.standing, spec.width)
        poses = PushPoseBonus(settings, tracker, occlusion, table, known, wanted, off > 0)
        return FollowedObjects(
            settings,
            spec,
            known,
            wanted,
            occlusion=occlusion,
            exploration=Exploration(settings, self._history, known, misplaced=off, push_poses=poses, spec=spec),
            falls=FallRisk(settings, tracker, occlusion, table, current, known),
        )

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The cost of the frames that the states look like."""
        assert self._objects is not None, "begin comes first"
        cost, known = self._objects.of_frames(pixels_of(dynamics, state), task, action, cost_state[0])
        return cost, (known,)
