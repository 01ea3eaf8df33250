"""How the small networks of these experiments are trained."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from dmotion_bench.learning.hardware.precision import autocast, has_bf16
from dmotion_bench.learning.model import ForwardModel, Phase, TripletBatch


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


def train(
    model: ForwardModel[Any], phase: Phase, batch: Callable[[], TripletBatch], *, steps: int, rate: float
) -> None:
    """Train what the phase trains, on the CPU, and say so on stderr.

    Args:
        model: Of the benchmark.
        phase: One of its phases.
        batch: What each step is given.
        steps, rate: See ``descend``.
    """
    model.enter(phase)
    model.train()
    device = torch.device("cpu")
    precision = "bf16" if has_bf16(device) else "float32"

    def loss() -> Tensor:
        with autocast(precision, device):
            return model.losses(batch()).total

    def tell(step: int, value: Tensor) -> None:
        if step % 100 == 1 or step == steps:
            sys.stderr.write(f"{phase.name}: {step:,} of {steps:,}, loss {value.item():.4f}\n")

    descend([one for one in model.parameters() if one.requires_grad], steps, rate, loss, tell)
