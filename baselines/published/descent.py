"""How the small networks of these experiments are trained."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn


def descend(
    parameters: Iterable[nn.Parameter],
    steps: int,
    rate: float,
    loss: Callable[[], Tensor],
    tell: Callable[[int, Tensor], None] = lambda step, value: None,
) -> None:
    """So many steps of Adam, the rate falling to zero along a cosine.

    Args:
        parameters: What is trained.
        steps: How many.
        rate: At the first step.
        loss: Of a batch of its own choice.
        tell: Told after each step how many there were, and the loss before it.
    """
    optimizer = torch.optim.Adam(parameters, rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        optimizer.zero_grad()
        value = loss()
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        tell(step + 1, value.detach())
