"""Gaussians with independent components, as variational models infer them (Kingma, Welling 2014)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Gaussian:
    """Gaussians in float32, one for each row of a batch.

    Attributes:
        mean: Of each component.
        log_variance: Likewise.
    """

    mean: Float[Tensor, "b d"]
    log_variance: Float[Tensor, "b d"]

    @classmethod
    def of(cls, moments: Float[Tensor, "b d2"]) -> Gaussian:
        """Build from a network's output: means and log variances side by side."""
        mean, log_variance = moments.float().chunk(2, dim=1)
        return cls(mean, log_variance)

    def sample(self) -> Float[Tensor, "b d"]:
        """Draw samples, with gradients (reparametrisation)."""
        return self.mean + torch.randn_like(self.mean) * torch.exp(0.5 * self.log_variance)

    def divergence(self) -> Float[Tensor, ""]:
        """Kullback-Leibler divergence from the unit Gaussian [nats], summed over components, mean over the batch."""
        each = 0.5 * (self.mean.square() + self.log_variance.exp() - 1 - self.log_variance)
        return each.sum(1).mean()
