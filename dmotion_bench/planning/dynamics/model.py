"""The predictions of a forward model, which sees two images and nothing else."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.contract import predicting
from dmotion_bench.planning.dynamics.base import Actions, Observation, State

FRAMES_AT_ONCE = {"cpu": 32, "cuda": 1024}
"""How many frames are predicted in one batch; on a CPU more do not stay in the cache [measured]."""


def arithmetic_on(device: torch.device) -> str:
    """In which arithmetic models imagine on a device, by its name in a report."""
    return "bfloat16" if has_bf16(device) else "float32"


@runtime_checkable
class FeatureModel(Protocol):
    """A model that describes its states by feature vectors."""

    def features(self, state: Any) -> Float[Tensor, "b d"]:
        """Feature vectors; the distance between two vectors measures how different the states are."""


@runtime_checkable
class BranchingModel(Protocol):
    """A model that computes only once what several actions at one state have in common."""

    def branch(self, state: Any, parent: Int[Tensor, " n"] | None, action: Any) -> Any:
        """The states after actions, row i at the state of row ``parent[i]``: ``advance`` of those rows."""


@runtime_checkable
class PixelModel(Protocol):
    """A model that turns its states into whole pixel values faster than by way of ``frame``."""

    def pixels(self, state: Any) -> UInt8[Tensor, "b h w 3"]:
        """``to_pixels(frame(state))``, in any memory order."""


class ModelDynamics:
    """A forward model as the dynamics.

    Args:
        model: Aligned, in evaluation mode, on ``device``.
        bf16: Whether matrices may be multiplied in bfloat16 where the hardware does so; None: where it has it.
        device: Where the model is.
        at_once: Frames predicted in one batch.

    Raises:
        ModelContractBroken: The model's actions are not known.
    """

    def __init__(
        self,
        model: ForwardModel[Any],
        *,
        bf16: bool | None = None,
        device: torch.device | None = None,
        at_once: int | None = None,
    ) -> None:
        self._model, self.device = model, device or torch.device("cpu")
        self._bf16 = has_bf16(self.device) if bf16 is None else bf16
        if model.inputs.actions is None:
            raise ModelContractBroken("the model's actions are not known, so nothing can be planned with it.")
        self.actions = model.inputs.actions
        self.at_once = at_once or FRAMES_AT_ONCE.get(self.device.type, 64)

    @contextlib.contextmanager
    def computing(self, *, gradients: bool = False) -> Iterator[None]:
        """In bfloat16 where that is allowed."""
        mode = torch.enable_grad() if gradients else torch.inference_mode()
        with mode, torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16):
            yield

    def start(self, observation: Observation) -> State:
        """The model's state after the last two images of each task."""
        images = (torch.from_numpy(one).to(self.device) for one in (observation.previous, observation.current))
        with predicting(self._model, "begin"):
            return as_tuple(self._model.begin(*map(to_model, images)))

    def step(self, state: State, action: Actions) -> State:
        """The states that the model predicts."""
        with predicting(self._model, "advance"):
            return as_tuple(self._model.advance(state, in_units(self.actions, action.to(self.device))))

    def branch(self, state: State, parent: Int[Tensor, " n"], action: Actions) -> State:
        """The states that the model predicts; what they have in common is computed once, if the model can do so."""
        parent, taken = parent.to(self.device), in_units(self.actions, action.to(self.device))
        if isinstance(self._model, BranchingModel):
            with predicting(self._model, "branch"):
                return as_tuple(self._model.branch(state, parent, taken))
        with predicting(self._model, "advance"):
            return as_tuple(self._model.advance(tuple(part[parent] for part in state), taken))

    def frames(self, state: State) -> Float[Tensor, "n c h w"]:
        """The frames that the model draws of the states.

        Raises:
            InvalidSetting: It draws none.
        """
        if not self._model.needs_pixels:
            raise InvalidSetting(
                f"{type(self._model).__name__} draws no frames, which the objective or the planner looks at; plan with "
                "'--objective feature --planner icem'."
            )
        with predicting(self._model, "frame"):
            return self._model.frame(state)

    def pixels(self, state: State) -> UInt8[Tensor, "n h w 3"]:
        """The same frames as whole pixel values, in the memory order that costs the model least."""
        if isinstance(self._model, PixelModel):
            with predicting(self._model, "pixels"):
                return self._model.pixels(state)
        return to_pixels(self.frames(state))

    def features(self, state: State) -> Float[Tensor, "n d"]:
        """The model's features; a model without any has its states compared number by number."""
        if isinstance(self._model, FeatureModel):
            with predicting(self._model, "features"):
                return self._model.features(state).float()
        return torch.cat([part.flatten(1).float() for part in state], dim=1)


def in_units(spec: ActionSpec | None, action: Tensor) -> Tensor:
    """Actions as a model takes them: numbers as they are, continuous ones in their units."""
    if not isinstance(spec, Continuous):
        return action
    reach, middle = (
        torch.as_tensor(one, dtype=action.dtype, device=action.device) for one in (spec.reach, spec.middle)
    )
    return action * reach + middle


def as_tuple(state: Any) -> State:
    """A model's state; models may carry a single tensor."""
    return state if isinstance(state, tuple) else (state,)
