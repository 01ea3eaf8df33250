"""Labelled transitions as models see them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

READ_AT_ONCE = 1024
"""Demonstrations whose images are in memory together."""


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Labelled transitions: ``next`` is what ``action`` made of ``current``.

    A model that reads something off each of them asks for it with ``read``, so that there may be more of them than the
    memory holds as images.
    """

    previous: Float[Tensor, "n c h w"]
    current: Float[Tensor, "n c h w"]
    next: Float[Tensor, "n c h w"]
    action: Int[Tensor, " n"] | Float[Tensor, "n a"]

    def __len__(self) -> int:
        return len(self.action)

    def subset(self, index: Int[Tensor, " m"]) -> Demonstrations:
        """These of them."""
        index = index.to(self.action.device)
        return Demonstrations(
            previous=self.previous[index], current=self.current[index], next=self.next[index], action=self.action[index]
        )

    def part(self, index: Int[Tensor, " m"]) -> Demonstrations:
        """These of them, kept as all are."""
        return self.subset(index)

    def read(self, function: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Tensor:
        """What a function of the three images gives for each demonstration, such as a latent action.

        Args:
            function: Called with ``previous``, ``current`` and ``next`` of some of them at a time.
        """
        if len(self) <= READ_AT_ONCE:
            return function(self.previous, self.current, self.next)
        starts = range(0, len(self), READ_AT_ONCE)
        some = (self.subset(torch.arange(start, min(start + READ_AT_ONCE, len(self)))) for start in starts)
        return torch.cat([function(one.previous, one.current, one.next) for one in some])

    def contiguous(self) -> Demonstrations:
        """The same transitions, their images contiguous in memory."""
        return Demonstrations(
            previous=self.previous.contiguous(),
            current=self.current.contiguous(),
            next=self.next.contiguous(),
            action=self.action,
        )
