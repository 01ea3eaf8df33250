"""Predictions of what actions lead to, from the present state of some tasks.

A planner works on ``Futures``: it starts from one state per task and takes states further by actions, many at a
time, and is told what each costs. ``ModelFutures`` imagines with a forward model, which sees two images and nothing
else; ``simulation.SimulatorFutures`` looks the future up in the simulator.
"""

from __future__ import annotations

import contextlib
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import require_discrete
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.optimization import has_bf16
from dmotion_bench.planning.costs import Cost
from dmotion_bench.planning.following import Following

States = tuple[Tensor, ...]
"""Tensors whose first axis is the batch."""

FRAMES_AT_ONCE = {"cpu": 32, "cuda": 1024}
"""How many frames are predicted in one batch; on a CPU more do not stay in the cache [measured]."""


@runtime_checkable
class Futures(Protocol):
    """Predicts states and their costs, for several tasks at once.

    Attributes:
        tasks: How many tasks stand side by side.
        actions: How many actions there are.
        at_once: How many states ``expand`` likes to be given.
    """

    @property
    def tasks(self) -> int: ...

    @property
    def actions(self) -> int: ...

    @property
    def at_once(self) -> int: ...

    def begin(self) -> States:
        """The present state of each task."""

    def expand(
        self, states: States, task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[States, Float[Tensor, " n"]]:
        """Each state after one more action, and its cost."""


class ModelFutures:
    """The predictions of a forward model.

    Args:
        model: Aligned, in evaluation mode.
        cost: The cost that the planner minimises.
        previous, current: The last two images of each task.
        bf16: Whether matrices may be multiplied in bfloat16 where the hardware does so; None: where it has it.
        at_once: Frames predicted in one batch.
    """

    def __init__(
        self,
        model: ForwardModel[Any],
        cost: Cost | Following,
        previous: UInt8[Tensor, "b h w 3"],
        current: UInt8[Tensor, "b h w 3"],
        *,
        bf16: bool | None = None,
        at_once: int | None = None,
    ) -> None:
        self._model, self._cost = model, cost
        self._previous, self._current = previous, current
        self._device = current.device
        self._bf16 = has_bf16(self._device) if bf16 is None else bf16
        self.tasks, self.actions = len(current), len(require_discrete(model.inputs.actions, "planning"))
        self.at_once = at_once or FRAMES_AT_ONCE.get(self._device.type, 64)

    def begin(self) -> States:
        """The model's state after the last two images of each task, and the cost's information."""
        with self._imagining():
            state = as_tuple(self._model.begin(to_model(self._previous), to_model(self._current)))
            return (*state, self._cost.begin()) if isinstance(self._cost, Following) else state

    def expand(
        self, states: States, task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[States, Float[Tensor, " n"]]:
        """The states that the model predicts, and their costs."""
        with self._imagining():
            task, action = task.to(self._device), action.to(self._device)
            if isinstance(self._cost, Following):
                after = as_tuple(self._model.advance(states[:-1], action))
                cost, known = self._cost.follow(self._model, after, task, action, states[-1])
                return (*after, known), cost.float().cpu()
            after = as_tuple(self._model.advance(states, action))
            return after, self._cost(self._model, after, task).float().cpu()

    @contextlib.contextmanager
    def _imagining(self) -> Any:
        with torch.inference_mode(), torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            yield


def as_tuple(state: Any) -> States:
    """A model's state; models may carry a single tensor."""
    return state if isinstance(state, tuple) else (state,)
