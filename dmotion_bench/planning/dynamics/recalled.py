"""A model's predictions, and in their place what was really seen to follow, where that is known."""

from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec
from dmotion_bench.planning.dynamics.base import Actions, Observation, State
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.experience import UNKNOWN, Experience


class RecalledDynamics:
    """The dynamics of a model, corrected by a task's experience; for discrete actions.

    A state that an experienced action leads to is the model's state after the two images that were really seen, so that
    every model can be corrected, and the predictions go on from there. The last part of each state is the number of its
    image in the experience.

    Args:
        model: Predicts what is not known.
        experience: What is.
    """

    def __init__(self, model: ModelDynamics, experience: Experience) -> None:
        self._model, self._experience = model, experience
        self._after = torch.from_numpy(experience.after).to(model.device)

    @property
    def actions(self) -> ActionSpec:
        """What can be done at each step."""
        return self._model.actions

    @property
    def at_once(self) -> int:
        """How many states ``step`` likes to be given."""
        return self._model.at_once

    @property
    def device(self) -> torch.device:
        """Where the states are."""
        return self._model.device

    def computing(self, *, gradients: bool = False) -> AbstractContextManager[None]:
        """See ``ModelDynamics``."""
        return self._model.computing(gradients=gradients)

    def start(self, observation: Observation) -> State:
        """The present state of each task."""
        return *self._model.start(observation), torch.from_numpy(self._experience.here).to(self.device)

    def step(self, state: State, action: Actions) -> State:
        """Each state after one more action."""
        return self.branch(state, torch.arange(len(action)), action)

    def branch(self, state: State, parent: Int[Tensor, " n"], action: Actions) -> State:
        """The states after actions, row i at the state of row ``parent[i]``."""
        *before, image = state
        parent, action = parent.to(self.device), action.to(self.device)
        after, here = self._model.branch(tuple(before), parent, action), image[parent]
        reached = torch.where(here != UNKNOWN, self._after[here.clamp(min=0), action], UNKNOWN)
        changed = ((reached != UNKNOWN) & (reached != here)).nonzero()[:, 0]
        stayed = ((reached != UNKNOWN) & (reached == here)).nonzero()[:, 0]
        if len(changed):
            seen = self._model.start(self._shown(here[changed], reached[changed]))
            after = _replaced(after, changed, seen)
        if len(stayed):
            after = _replaced(after, stayed, tuple(part[parent[stayed]] for part in before))
        return *after, reached

    def frames(self, state: State) -> Float[Tensor, "n c h w"]:
        """The frames that the states look like."""
        return self._model.frames(state[:-1])

    def pixels(self, state: State) -> UInt8[Tensor, "n h w 3"]:
        """The same frames as whole pixel values."""
        return self._model.pixels(state[:-1])

    def features(self, state: State) -> Float[Tensor, "n d"]:
        """The model's features."""
        return self._model.features(state[:-1])

    def _shown(self, previous: Int[Tensor, " m"], current: Int[Tensor, " m"]) -> Observation:
        before, now = (
            np.stack([self._experience.images[number] for number in numbers.tolist()])
            for numbers in (previous, current)
        )
        return Observation(previous=before, current=now, goals=now)


def _replaced(state: State, rows: Int[Tensor, " m"], others: State) -> State:
    """A state with some of its rows from another one."""
    return tuple(part.index_copy(0, rows, other.to(part.dtype)) for part, other in zip(state, others, strict=True))
