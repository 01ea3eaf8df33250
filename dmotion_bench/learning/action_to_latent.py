"""What a model of video learns of actions afterwards: which of its latent actions an action is.

For discrete actions this is a table: the mean latent action of each action's demonstrations, which is the least-squares
optimum of any map from an action to a latent one. For continuous actions it is a ridge regression (Hoerl, Kennard 1970)
from the normalised action; the regularisation is the one with the least leave-one-out error, which has a closed form
(Allen's PRESS, 1974).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions

PENALTIES = torch.logspace(-6, 3, 37, dtype=torch.float64)
"""The regularisations that are tried, per demonstration; the normalised numbers of an action are at most 1."""


class ActionToLatent(nn.Module):
    """A map from actions to latent actions, kept in one buffer, so that a checkpoint keeps it.

    Args:
        spec: Of the actions; None, if they are not known, stands for a map that cannot be asked.
        width: Length of a latent action.
        unaligned: The latent action of every action before ``fit``; zeros if left out.

    Attributes:
        rows: A row for each discrete action; or the latent action of a continuous action's middle, and how it changes
            with each of the action's normalised numbers.
    """

    rows: Tensor

    def __init__(self, spec: ActionSpec | None, width: int, unaligned: Float[Tensor, " d"] | None = None) -> None:
        super().__init__()
        self.spec, self.encoding = spec, ActionEncoding(spec)
        start = torch.zeros(1, width) if unaligned is None else unaligned[None]
        if isinstance(spec, Continuous):
            rows = torch.cat([start, torch.zeros(spec.width, width)])
        else:
            rows = start.repeat(self.encoding.width, 1)
        self.register_buffer("rows", rows)

    @torch.no_grad()
    def fit(self, latent: Float[Tensor, "n d"], action: Actions) -> None:
        """Learn from demonstrations; a discrete action without demonstrations keeps its row.

        Args:
            latent: The latent action that the model reads off each demonstration.
            action: What was done in it.
        """
        if isinstance(self.spec, Continuous):
            self.rows.copy_(ridge(self.encoding(action), latent))
            return
        for number in range(len(self.rows)):
            if (of_action := latent[action == number]).numel():
                self.rows[number] = of_action.float().mean(0)

    def forward(self, action: Actions) -> Float[Tensor, "b d"]:
        if isinstance(self.spec, Continuous):
            changes = self.encoding(action)[..., None] * self.rows[1:]
            found: Tensor = self.rows[0] + changes.sum(-2)
            return found
        return self.rows[action]


def ridge(inputs: Float[Tensor, "n a"], outputs: Float[Tensor, "n d"]) -> Float[Tensor, "a+1 d"]:
    """The regression of ``outputs`` on ``inputs`` with the least leave-one-out error; the first row is the intercept.

    The intercept is not penalised. With one demonstration it is all that there is.
    """
    known, wanted = inputs.double().cpu(), outputs.double().cpu()
    offset, level = known.mean(0), wanted.mean(0)
    left, values, right = torch.linalg.svd(known - offset, full_matrices=False)
    along = left.T @ (wanted - level)
    errors = [_left_out(left, values, along, wanted - level, float(one)) for one in PENALTIES * len(known)]
    best = float(PENALTIES[min(range(len(errors)), key=lambda place: (errors[place], -place))]) * len(known)
    slopes = right.T @ ((values / (values.square() + best))[:, None] * along)
    found = torch.cat([(level - offset @ slopes)[None], slopes])
    return found.to(outputs)


def _left_out(
    left: Float[Tensor, "n m"],
    values: Float[Tensor, " m"],
    along: Float[Tensor, "m d"],
    wanted: Float[Tensor, "n d"],
    penalty: float,
) -> float:
    """The summed squared error of each row by the regression of all others."""
    shrunk = values.square() / (values.square() + penalty)
    leverage = 1 / len(left) + left.square() @ shrunk
    residual = wanted - left @ (shrunk[:, None] * along)
    return float((residual / (1 - leverage).clamp(min=1e-9)[:, None]).square().sum())
