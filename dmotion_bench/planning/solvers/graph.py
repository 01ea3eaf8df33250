"""iCEM that searches for a way where no plan gains anything.

What is out of reach within the horizon costs the same whatever is done, so no plan is better than another. Then a
breadth-first search goes through the images that actions lead to. It goes on from an image only if nothing is worse in
it, and if none like it was met before: duplicate detection, as in any search of a graph (Russell and Norvig,
"Artificial Intelligence: A Modern Approach", section 3.3). So it predicts about as many states as there are different
images, where the sequences that lead to them are too many to be drawn. The shortest way to a gain is followed as long
as it promises one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import PARTS
from dmotion_bench.planning.solvers.base import Plan, PlanContext
from dmotion_bench.planning.solvers.icem import ImprovedCrossEntropy
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree, needs_discrete
from dmotion_bench.planning.solvers.search import Search
from dmotion_bench.values import require_bounds

_END: Final = -1  # behind the last action of a way
_LOWERING: Final = 1 / 3  # of the actions at most lower the cost, it is assumed
SIDE: Final = 32
"""Of the small images that are compared [px]; what is finer is often noise of a model."""


@dataclass(frozen=True, kw_only=True)
class GraphCrossEntropy(ImprovedCrossEntropy):
    """iCEM and, in tasks where its plan does not gain enough, a search for a way.

    It needs discrete actions, and a model that draws frames.

    A plan's gain is the share that it saves of what most single actions leave the cost at, which is what it is now. A
    third of them may lower it, and two thirds may do harm.

    Attributes:
        least_gain: What a plan must gain.
        most_loss: What a state on the way may cost more, as a share likewise.
        depth: Actions in a way at most.
        most_states: A search ends with the length of way at which it has looked at so many states.
        alike: Two images are alike if the mean square of their difference is at most this share of what the first
            actions change, by the median of those that change something.
        look_every: Steps from one search for a way to the next, in tasks where none is being followed.
    """

    looks_at_frames: ClassVar[bool] = True
    least_gain: float = 0.05
    most_loss: float = 0.02
    depth: int = 15
    most_states: int = 300
    alike: float = 0.25
    look_every: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        require_bounds(
            self,
            from_one=("depth", "most_states", "look_every"),
            from_zero=("least_gain", "most_loss", "alike"),
            below_one=("least_gain",),
        )

    @property
    def _farthest(self) -> int:
        return max(self.horizon, self.depth + 1)  # a tree keeps no states at its end

    def _planned(self, sought: Search, dynamics: Dynamics, context: PlanContext) -> Plan:
        """The plan of iCEM, or a way where only that gains enough; what is shown is cut off at ``horizon``.

        The last sequence that is remembered is the way that is being followed; -1 stands behind its last action.

        Raises:
            InvalidSetting: The actions are continuous.
        """
        if not isinstance(sought, PrefixTree):
            raise needs_discrete(dynamics.actions)
        tree, memory = sought, context.memory
        near = None if memory is None or memory.shape[1] == 1 else memory[:, :-1, : self.horizon]
        plan = super()._planned(tree, dynamics, replace(context, memory=near))
        tasks = len(plan.action)
        each = np.broadcast_to(np.arange(tree.actions)[:, None], (tasks, tree.actions, 1))
        left = np.quantile(tree.costs(each)[:, :, 0], _LOWERING, axis=1, method="lower")
        stuck = plan.costs[:, 0] > self._enough(left)
        ways = np.full((tasks, self._farthest), _END)
        for task in np.flatnonzero(stuck).tolist():
            way = None if memory is None else self._followed(tree, task, memory[task, -1, 1:], left[task])
            if way is None and not context.observation.step % self.look_every:
                way = self._found(tree, task, context, left[task])
            if way is not None:
                ways[task, : len(way)] = way
        return self._exchanged(plan, tree, ways)

    def _enough(self, left: Any) -> Any:
        """What a plan may cost that gains enough."""
        return left - self.least_gain * np.abs(left)

    def _followed(
        self, tree: PrefixTree, task: int, remembered: Int[np.ndarray, " t"], left: float
    ) -> Int[np.ndarray, " w"] | None:
        """What remains of a way that was followed, if it still promises to gain enough."""
        way = remembered[remembered != _END]
        promising = len(way) and tree.costs_of(task, way[None])[0, 0] <= self._enough(left)
        return way if promising else None

    def _found(self, tree: PrefixTree, task: int, context: PlanContext, left: float) -> Int[np.ndarray, " w"] | None:
        """The shortest way to a gain that is enough; of several the one with the lowest cost."""
        here = _small(torch.from_numpy(context.observation.current[[task]]))
        known, unlike, predicted = here, 0.0, 0
        ways = np.flatnonzero(~context.blocked[task])[:, None]
        while len(ways) and ways.shape[1] <= self.depth and predicted < self.most_states:
            costs, predicted = tree.costs_of(task, ways)[:, 0], predicted + len(ways)
            if costs.min() <= self._enough(left):
                found: Int[np.ndarray, " w"] = ways[costs.argmin()]
                return found
            images = _small(tree.pixels_of(task, ways))
            if ways.shape[1] == 1:
                changes = _differences(images, here[0])
                unlike = self.alike * float(changes[changes > 0].median()) if changes.any() else 0.0
            harmless = costs <= left + self.most_loss * abs(left)
            new = np.zeros(len(ways), np.bool_)
            for row in np.flatnonzero(harmless).tolist():
                if _differences(known, images[row]).min() > unlike:
                    new[row], known = True, torch.cat([known, images[row : row + 1]])
            ways = _longer(ways[new], tree.actions)
        return None

    def _exchanged(self, plan: Plan, tree: PrefixTree, ways: Int[np.ndarray, "b t"]) -> Plan:
        """A plan in which the tasks with a way take it; it is shown in place of all of their candidates."""
        changed: dict[str, Any] = {
            one: getattr(plan, one).copy() for one in ("action", "candidates", "costs", "progress")
        }
        parts = {name: part.copy() for name, part in plan.parts.items()}
        memory = ways[:, None]
        if plan.memory is not None:
            lacking = self._farthest - plan.memory.shape[2]
            memory = np.concatenate([np.pad(plan.memory, ((0, 0), (0, 0), (0, lacking)), mode="edge"), memory], axis=1)
        for task in np.flatnonzero(ways[:, 0] != _END).tolist():
            way = ways[task][ways[task] != _END]
            total, *others = tree.costs_of(task, way[None])[0].tolist()
            full = np.pad(way, (0, self._farthest - len(way)), mode="edge")
            changed["action"][task], changed["candidates"][task] = way[0], full[: self.horizon]
            changed["costs"][task] = changed["progress"][task] = total
            for name, part in zip(PARTS, others, strict=True):
                parts[name][task] = part
            if plan.memory is not None:
                memory[task, 0] = full
        return replace(plan, **changed, parts=parts, memory=memory, frames=tree.frames)

    def _carried_on(self, memory: Any) -> Plan:
        """See ``CrossEntropy``; the way comes after the sequences that can be shown."""
        plan, way = super()._carried_on(memory[:, :-1]), memory[:, -1:, 1:]
        rest = np.pad(way, ((0, 0), (0, 0), (0, 1)), constant_values=_END)
        return replace(plan, memory=np.concatenate([plan.memory, rest], axis=1))


def _longer(ways: Int[np.ndarray, "n t"], actions: int) -> Int[np.ndarray, "m _t"]:
    """Each way with each action behind it."""
    behind = np.tile(np.arange(actions), len(ways))
    return np.concatenate([ways.repeat(actions, axis=0), behind[:, None]], axis=1)


def _small(images: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n d"]:
    """Images in ``SIDE`` x ``SIDE`` pixels."""
    return functional.adaptive_avg_pool2d(images.permute(0, 3, 1, 2).float(), SIDE).flatten(1)


def _differences(images: Float[Tensor, "n d"], other: Float[Tensor, " d"]) -> Float[Tensor, " n"]:
    """The mean square of the difference of each image from another one."""
    return (images - other).square().mean(dim=1)
