"""Tracked objects, and beyond the horizon a learned distance: how many steps of video lie between a state and the goal.

Within a few steps a planner reaches few objects, so most plans cost the same. What the video of the training teaches
about time (``learning/temporal_distance.py``) tells such plans apart, for any scene: a state is better from which the
goal's picture is fewer steps away. It knows nothing of what moves, so the agent's own place counts, too.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.temporal_distance import TemporalDistance, load
from dmotion_bench.planning.dynamics.base import Dynamics, State
from dmotion_bench.planning.objectives.base import CostState, StepCost
from dmotion_bench.planning.objectives.centres import require_objects
from dmotion_bench.planning.objectives.tracked import Tracked, TrackedEvaluator
from dmotion_bench.specs import EnvSpec
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class StepsToGo(Tracked):
    """The cost of tracked objects, less a bonus for states that are few steps from the goal [px^2].

    Attributes:
        value: The name of the learned distance, a hash; ``python -m dmotion_bench.learning.temporal_distance`` prints
            it.
        step_bonus: For each step that a state is nearer than the learned distance reaches [px^2].
    """

    value: str = ""
    step_bonus: float = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_bounds(self, from_zero=("step_bonus",))

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> StepsToGoEvaluator:
        """Begin some tasks.

        Raises:
            InvalidSetting: The environment has no coloured objects, or there is no learned distance of this name.
        """
        require_objects(spec)
        return StepsToGoEvaluator(spec, torch.from_numpy(first), torch.from_numpy(goals), self, _loaded(self.value))


class StepsToGoEvaluator(TrackedEvaluator):
    """Remembers where the objects are, and the goals' vectors.

    Args:
        spec, first, goals, settings: See ``TrackedEvaluator``.
        network: The learned distance; it is left as it is.
    """

    def __init__(
        self,
        spec: EnvSpec,
        first: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
        settings: StepsToGo,
        network: TemporalDistance,
    ) -> None:
        super().__init__(spec, first, goals, settings)
        # of its own, because ``begin`` moves it to a device and other tasks embed their goals later
        self._network = copy.deepcopy(network)
        self._bonus = settings.step_bonus
        with torch.inference_mode():
            self._goal = network.embed(to_model(goals))

    def begin(self, dynamics: Dynamics) -> CostState:
        """The network and the goals come to the dynamics' device."""
        self._network, self._goal = self._network.to(dynamics.device), self._goal.to(dynamics.device)
        return super().begin(dynamics)

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The cost of tracked objects, and the bonus."""
        cost, carried = super().step(dynamics, state, task, action, cost_state)
        bonus = self._bonus * self.steps_saved(dynamics.frames(state).float(), task)
        return replace(cost, bonus=bonus, total=cost.distance - bonus), carried

    def steps_saved(self, frames: Float[Tensor, "n c h w"], task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """By how many steps frames are nearer to their goals than the learned distance reaches."""
        apart = self._network.between(self._network.embed(frames), self._goal[task])
        return self._network.config.reach - apart


@lru_cache(maxsize=4)
def _loaded(name: str) -> TemporalDistance:
    return load(name)
