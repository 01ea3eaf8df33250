"""How a model is given an action: as a vector of a known width, whatever kind of action it is.

A discrete action becomes a one-hot vector, a continuous one is normalised from its bounds to [-1, 1]. This is the one
place where a model's actions are normalised.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from dmotion_bench.actions import ActionSpec, Continuous

Actions = Int[Tensor, " b"] | Float[Tensor, "b a"]
"""A batch of actions: numbers of discrete ones, or vectors of continuous ones in their units."""


class ActionEncoding(nn.Module):
    """Actions as vectors. It has no weights, and leaves no trace in a checkpoint.

    Args:
        spec: Of the actions; None, if they are not known, stands for vectors without numbers.

    Attributes:
        width: Length of a vector.
    """

    middle: Tensor
    reach: Tensor

    def __init__(self, spec: ActionSpec | None) -> None:
        super().__init__()
        self.spec, self.width = spec, 0 if spec is None else spec.width
        if isinstance(spec, Continuous):
            for name in ("middle", "reach"):
                bounds = torch.as_tensor(getattr(spec, name), dtype=torch.float32)
                self.register_buffer(name, bounds, persistent=False)

    def forward(self, action: Actions) -> Float[Tensor, "b a"]:
        """One-hot, or from the units to [-1, 1]."""
        if isinstance(self.spec, Continuous):
            return (action.float() - self.middle) / self.reach
        return F.one_hot(action, self.width).float()


class _ContinuousEmbedding(nn.Linear):
    def __init__(self, spec: Continuous, width: int) -> None:
        super().__init__(spec.width, width)
        self.encoding = ActionEncoding(spec)

    def forward(self, action: Tensor) -> Tensor:
        return super().forward(self.encoding(action))


def action_embedding(spec: ActionSpec | None, width: int) -> nn.Module:
    """A learned linear map from actions to vectors: a row for each discrete action, or a matrix and a bias.

    Args:
        spec: Of the actions.
        width: Length of the vectors.

    Returns:
        A module that is called with a batch of actions.
    """
    if isinstance(spec, Continuous):
        return _ContinuousEmbedding(spec, width)
    return nn.Embedding(0 if spec is None else len(spec), width)


def as_tensor(
    actions: Int[np.ndarray, "*b"] | Float[np.ndarray, "*b a"], device: torch.device | None = None
) -> Int[Tensor, "*b"] | Float[Tensor, "*b a"]:
    """Stored actions in the type in which models take them: 64-bit numbers of actions, or 32-bit continuous ones."""
    kind = torch.float32 if np.issubdtype(actions.dtype, np.floating) else torch.int64
    return torch.from_numpy(np.ascontiguousarray(actions)).to(device, kind)
