"""What a dynamics is: it predicts what actions lead to, from what has been observed, for many states at once."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec
from dmotion_bench.learning.images import to_pixels

State = tuple[Tensor, ...]
"""Tensors whose first axis is the batch."""

Actions = Int[Tensor, " n"] | Float[Tensor, "n a"]
"""Numbers of discrete actions, or continuous ones in [-1, 1]."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What is seen of some tasks at one control step: images, nothing else.

    Attributes:
        previous, current: The last two images; at the start the first one twice. A step that changed nothing in the
            picture is not counted.
        goals: What it should look like.
        step: How many actions were taken before.
    """

    previous: UInt8[np.ndarray, "b h w 3"]
    current: UInt8[np.ndarray, "b h w 3"]
    goals: UInt8[np.ndarray, "b h w 3"]
    step: int = 0


@runtime_checkable
class Dynamics(Protocol):
    """Predicts states and the frames that they look like.

    Attributes:
        actions: What can be done at each step.
        at_once: How many states ``step`` likes to be given.
        device: Where the states are.
    """

    @property
    def actions(self) -> ActionSpec: ...

    @property
    def at_once(self) -> int: ...

    @property
    def device(self) -> torch.device: ...

    def computing(self, *, gradients: bool = False) -> AbstractContextManager[None]:
        """The arithmetic in which the other methods, and what is made of their results, are to be called.

        Args:
            gradients: Whether gradients of what follows are to reach the actions.

        Raises:
            InvalidSetting: There are no gradients.
        """

    def start(self, observation: Observation) -> State:
        """The present state of each task."""

    def step(self, state: State, action: Actions) -> State:
        """Each state after one more action: its number, or if actions are continuous, in [-1, 1]."""

    def frames(self, state: State) -> Float[Tensor, "n c h w"]:
        """The frames that the states look like, in [-1, 1]."""

    def features(self, state: State) -> Float[Tensor, "n d"]:
        """Each state as a vector; the distance between two vectors measures how different the states are."""


@runtime_checkable
class Branching(Protocol):
    """A dynamics that predicts several actions at one state for less than as many states with one action each."""

    def branch(self, state: State, parent: Int[Tensor, " n"], action: Actions) -> State:
        """The states after actions, row i at the state of row ``parent[i]``: ``step`` of those rows."""


@runtime_checkable
class Pixels(Protocol):
    """A dynamics that gives its frames as pixels by itself."""

    def pixels(self, state: State) -> UInt8[Tensor, "n h w 3"]:
        """The frames that the states look like, as whole pixel values, in any memory order."""


def branched(dynamics: Dynamics, state: State, parent: Int[Tensor, " n"], action: Actions) -> State:
    """The states after actions, each at one of some states; see ``Branching``."""
    if isinstance(dynamics, Branching):
        return dynamics.branch(state, parent, action)
    return dynamics.step(tuple(part[parent.to(part.device)] for part in state), action)


def pixels_of(dynamics: Dynamics, state: State) -> UInt8[Tensor, "n h w 3"]:
    """The frames that states look like, as whole pixel values; see ``Pixels``."""
    return dynamics.pixels(state) if isinstance(dynamics, Pixels) else to_pixels(dynamics.frames(state))
