"""How well a model names actions that it was not told: the figures of models with an inverse model of their own.

- ``inverse_accuracy``: how often the named action of a held-out triplet is the true one.
- ``inverse_error``: the same for continuous actions: squared error of the named one, normalised to [-1, 1], averaged
  over its numbers.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions


@runtime_checkable
class InverseModel(Protocol):
    """A model that names the action between frames. Images as in ``learning/model.py``."""

    def infer_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Actions:
        """The action at ``current`` that leads to ``following``."""


def inverse_figures(named: Actions, action: Actions, spec: ActionSpec | None) -> dict[str, Float[Tensor, " b"]]:
    """The figure of each triplet: of its kind of action, the other is left out.

    Raises:
        ModelContractBroken: There is not an action for each triplet, or one holds NaN or infinity.
    """
    if named.shape != action.shape:
        raise ModelContractBroken(
            f"infer_action gave actions of the shape {tuple(named.shape)}; the contract asks for {tuple(action.shape)}."
        )
    if not bool(torch.isfinite(named).all()):
        raise ModelContractBroken("infer_action gave actions that hold NaN or infinity; the training diverged.")
    if isinstance(spec, Continuous):
        encoding = ActionEncoding(spec).to(action.device)
        return {"inverse_error": (encoding(named) - encoding(action)).square().mean(1)}
    return {"inverse_accuracy": (named == action).float()}
