"""The table from named actions to latent actions: each row is the mean over an action's demonstrations.

For discrete actions this mean is the least-squares optimum of any network from the action to the latent action, such as
CLASP's, so nothing is gained by training one.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class ActionTable(nn.Module):
    """Zeros until it is filled.

    Args:
        actions: Number of named actions.
        length: Of a latent action.
    """

    rows: Tensor

    def __init__(self, actions: int, length: int) -> None:
        super().__init__()
        self.register_buffer("rows", torch.zeros(actions, length))

    @torch.no_grad()
    def fill(self, latent: Float[Tensor, "n d"], action: Int[Tensor, " n"]) -> None:
        """Fill the table from demonstrations; an action without demonstrations keeps its row."""
        for number in range(len(self.rows)):
            if (of_action := latent[action == number]).numel():
                self.rows[number] = of_action.float().mean(0)

    def forward(self, action: Int[Tensor, " b"]) -> Float[Tensor, "b d"]:
        return self.rows[action]
