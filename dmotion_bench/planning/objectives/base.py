"""What an objective is: what a planner minimises, and what it remembers of an episode to do so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.contract import calling
from dmotion_bench.planning.dynamics.base import Actions, Dynamics, State
from dmotion_bench.specs import EnvSpec
from dmotion_bench.storage.readable import ReadableDataset

CostState = tuple[Tensor, ...]
"""What a cost carries from one predicted step to the next, besides the dynamics' state; empty if nothing."""

Taken = Int[np.ndarray, " b"] | Float[np.ndarray, "b a"]
"""Actions that were taken: numbers, -1 for none, or continuous ones in their units, NaN for none."""

PARTS = ("distance", "risk", "bonus")


@dataclass(frozen=True, kw_only=True)
class StepCost:
    """What some predicted states cost, in named parts.

    Attributes:
        distance: From the goal.
        risk: What is to be feared, in the units of the distance.
        bonus: What is preferred among states that are equally good otherwise; it lowers the cost.
        total: What is minimised, ``distance + risk - bonus``; added up by the objective, so that the order of its sums,
            and with it their rounding, is the objective's own.
    """

    distance: Float[Tensor, " n"]
    risk: Float[Tensor, " n"]
    bonus: Float[Tensor, " n"]
    total: Float[Tensor, " n"]

    @classmethod
    def of(cls, distance: Float[Tensor, " n"]) -> StepCost:
        """A distance alone."""
        nothing = torch.zeros_like(distance)
        return cls(distance=distance, risk=nothing, bonus=nothing, total=distance)

    def stacked(self) -> Float[Tensor, "n 4"]:
        """The total and the parts, in the order of ``PARTS``."""
        return torch.stack([self.total, *(getattr(self, name) for name in PARTS)], dim=1).float()


@runtime_checkable
class Evaluator(Protocol):
    """An objective at work on some tasks: it holds what was seen of them since their start."""

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """What was really done, and what is seen after it."""

    def begin(self, dynamics: Dynamics) -> CostState:
        """Before the predictions of a control step: what they start from, one row a task."""

    def step(
        self,
        dynamics: Dynamics,
        state: State,
        task: Int[Tensor, " n"],
        action: Actions,
        cost_state: CostState,
    ) -> tuple[StepCost, CostState]:
        """What predicted states cost.

        Args:
            dynamics: Whose states they are.
            state: The states after ``action``.
            task: The task of each, on the dynamics' device.
            action: That led to each, likewise.
            cost_state: Of the states before.
        """


@runtime_checkable
class Objective(Protocol):
    """The settings of an objective: a frozen dataclass, complete when constructed."""

    def reset(
        self, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> Evaluator:
        """Begin some tasks.

        Args:
            spec: Of the environment.
            first, goals: What is seen at the start, and what should be seen at the end.

        Raises:
            InvalidSetting: The objective needs something that the environment lacks.
        """


@runtime_checkable
class LearnsFromVideo(Protocol):
    """The settings of an objective that learns something from video, without labels, before it is used."""

    def learned(self, video: ReadableDataset) -> Objective:
        """The objective after it has seen the video of a data set."""


def taught(objective: Objective, video: ReadableDataset) -> Objective:
    """An objective that has learned from a data set's video what it wants to know; most want nothing."""
    if not isinstance(objective, LearnsFromVideo):
        return objective
    with calling(objective, "learned"):
        return objective.learned(video)


class Memoryless:
    """An evaluator that remembers nothing, for objectives to build on."""

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """Nothing is kept."""

    def begin(self, dynamics: Dynamics) -> CostState:
        """Nothing is carried."""
        return ()
