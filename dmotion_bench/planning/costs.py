"""How far a predicted future is from the goal.

The paper (section III-C): the summed squared distances, over objects, between the centres that are found in the
predicted frame and those in the goal image; the minimum over the horizon is the planner's business. An object that
the goal shows and the prediction lacks costs a fixed distance. The agent does not count.

Models that do not draw frames (``needs_pixels`` is False) are asked for features instead, or their states are
compared as they are.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, State
from dmotion_bench.planning.approaching import Approach
from dmotion_bench.planning.covering import Ground
from dmotion_bench.planning.edges import Edges
from dmotion_bench.planning.exploring import Exploration, Sights, misplaced
from dmotion_bench.planning.following import LOST, FollowedCost, Following
from dmotion_bench.planning.table import Table
from dmotion_bench.planning.tracking import Outlines, Tracker, believed
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import EnvSpec

COSTS = ("followed", "tracked", "position", "pixel", "feature")


@runtime_checkable
class FeatureModel(Protocol):
    """A model that describes its states by feature vectors."""

    def features(self, state: State) -> Float[Tensor, "b d"]:
        """Feature vectors; the distance between two vectors measures how different the states are."""


@runtime_checkable
class Cost(Protocol):
    """Computes the cost of predicted states; each state belongs to one task."""

    def __call__(self, model: ForwardModel[Any], state: State, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of each state; zero at the goal."""


class PositionCost:
    """The paper's: summed squared distances of the objects' centres [px^2].

    Args:
        spec: Says what the objects look like.
        goals: The goal image of each task.
        missing: The distance that an object costs which the goal shows and the prediction lacks [px].
    """

    def __init__(self, spec: EnvSpec, goals: UInt8[Tensor, "b h w 3"], missing: float | None = None) -> None:
        if not spec.objects:
            raise InvalidSetting(f"{spec.id!r} has no coloured objects to find; plan with another '--cost'.")
        self._finder, self._objects = PositionFinder(spec), len(spec.objects)
        self._missing = float(spec.width * LOST if missing is None else missing)
        wanted = self._finder.find(goals)
        self._centre, self._wanted = wanted.centre[:, : self._objects], wanted.found[:, : self._objects]

    def of_frames(self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of pictures."""
        seen = self._finder.find(frames)
        return self._of(seen.centre[:, : self._objects], seen.found[:, : self._objects], task)

    def of_looks(self, now: Outlines, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of what pictures show."""
        return self._of(now.centre, now.seen, task)

    def _of(
        self, centre: Float[Tensor, "n k 2"], found: Bool[Tensor, "n k"], task: Int[Tensor, " n"]
    ) -> Float[Tensor, " n"]:
        squared = (centre - self._centre[task]).square().sum(-1)
        squared = squared.where(found, squared.new_tensor(self._missing**2))
        return torch.where(self._wanted[task], squared, 0.0).sum(-1)

    def __call__(self, model: ForwardModel[Any], state: State, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of the frames that the states look like."""
        return self.of_frames(to_pixels(model.frame(state)), task)


class TrackedCost:
    """The same squared distances, with each hidden object at its estimated place (``tracking.py``) [px^2].

    An object that is seen now and not in the prediction costs as in ``PositionCost``: it may have been lost.

    Args:
        spec: Says what the objects look like.
        known: Where they are now, by all that has been seen.
        wanted: Where they should be; what the goal image does not show at all does not count.
    """

    def __init__(self, spec: EnvSpec, known: Outlines, wanted: Outlines) -> None:
        self._tracker, self._known, self._wanted = Tracker(spec), known, wanted
        self._missing = float(spec.width * LOST)

    def of_looks(self, now: Outlines, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of what pictures show."""
        known = self._known.of(task)
        squared = (believed(known, now).centre - self._wanted.centre[task]).square().sum(-1)
        squared = squared.where(now.seen | ~known.seen, squared.new_tensor(self._missing**2))
        return torch.where(self._wanted.seen[task], squared.nan_to_num(self._missing**2), 0.0).sum(-1)

    def __call__(self, model: ForwardModel[Any], state: State, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of the frames that the states look like."""
        return self.of_looks(self._tracker.look(to_pixels(model.frame(state))), task)


class PixelCost:
    """Mean squared difference between the predicted frame and the goal image, in [-1, 1] units; the agent counts."""

    def __init__(self, goals: UInt8[Tensor, "b h w 3"]) -> None:
        self._goals = to_model(goals)

    def __call__(self, model: ForwardModel[Any], state: State, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of the frames that the states look like."""
        return (model.frame(state).float() - self._goals[task]).square().flatten(1).mean(1)


class FeatureCost:
    """Squared distance between the features of a state and of the goal image, given twice; the agent counts.

    A model that is no ``FeatureModel`` has its states compared number by number.
    """

    def __init__(self, model: ForwardModel[Any], goals: UInt8[Tensor, "b h w 3"]) -> None:
        images = to_model(goals)
        self._goals = features_of(model, model.begin(images, images))

    def __call__(self, model: ForwardModel[Any], state: State, task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The cost of the states."""
        return (features_of(model, state) - self._goals[task]).square().mean(1)


def features_of(model: ForwardModel[Any], state: State) -> Float[Tensor, "b d"]:
    """A state as a vector."""
    if isinstance(model, FeatureModel):
        return model.features(state).float()
    parts = state if isinstance(state, tuple) else (state,)
    return torch.cat([part.flatten(1).float() for part in parts], dim=1)


def cost_name(name: str | None, spec: EnvSpec, *, needs_pixels: bool) -> str:
    """The cost that a name stands for; None is the one that suits the model and the environment.

    Models of pixels are asked for positions of objects: of followed objects where objects are told by their hue, since
    blurred edges have hues, too; else of tracked ones. Other models are asked for features.
    """
    if name is not None:
        return name
    return "feature" if not (needs_pixels and spec.objects) else "followed" if spec.shaded else "tracked"


def make_cost(
    name: str | None,
    model: ForwardModel[Any],
    spec: EnvSpec,
    current: UInt8[Tensor, "b h w 3"],
    goals: UInt8[Tensor, "b h w 3"],
    tracked: tuple[Outlines, Outlines] | None = None,
    sights: Sights | None = None,
) -> Cost | Following:
    """A cost by its name; None is the one that ``cost_name`` chooses.

    Args:
        current, goals: The present images, and those that are wanted.
        tracked: Where objects are and where they should be; without it both images are looked at by themselves.
        sights: All that has been seen; without it the cost of followed objects sends nobody exploring.

    Raises:
        UnknownName: There is no such cost.
    """
    name = cost_name(name, spec, needs_pixels=model.needs_pixels)
    if name == "position" or (name in ("tracked", "followed") and tracked is None):
        return PositionCost(spec, goals)
    if name == "followed" and tracked is not None:
        known, wanted = tracked
        ground, exploration = Ground(tracker := Tracker(spec), current, known), None
        table = Table(ground, current, goals)
        if sights is not None:
            off = misplaced(known, wanted, ground.standing, spec.width)
            approach = Approach(tracker, ground, table, known, wanted, off > 0)
            exploration = Exploration(sights.to(current.device), known, misplaced=off, approach=approach, spec=spec)
        edges = Edges(tracker, ground, table, current, known)
        return FollowedCost(spec, known, wanted, ground=ground, exploration=exploration, edges=edges)
    if name == "tracked" and tracked is not None:
        return TrackedCost(spec, *tracked)
    if name == "pixel":
        return PixelCost(goals)
    if name == "feature":
        return FeatureCost(model, goals)
    raise UnknownName("cost", name, COSTS)
