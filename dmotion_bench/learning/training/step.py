"""One step of an optimiser on a batch: the same in a training and in the measurement before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dmotion_bench.learning.hardware.precision import Precision, autocast
from dmotion_bench.learning.model import ForwardModel, Losses, TripletBatch
from dmotion_bench.learning.training.figures import StepFigures
from dmotion_bench.learning.training.randomness import seeded


@dataclass(frozen=True, kw_only=True)
class Stepper:
    """Takes steps with a model.

    Attributes:
        model: Its parameters are changed.
        losses: Its losses, by whatever stands around it where several processes train together.
        backward: Differentiates a loss.
        optimizer: Over the model's parameters.
        clip_norm: See ``TrainingConfig``.
        seed: The random numbers of a step depend on it and on the step's number.
        device: Where.
        rank: Of this process among those that train together; its random numbers are its own.
    """

    model: ForwardModel[Any]
    losses: Callable[[TripletBatch], Losses]
    backward: Callable[[Tensor], object]
    optimizer: torch.optim.Optimizer
    clip_norm: float
    seed: int
    device: torch.device
    rank: int = 0

    def __call__(self, batch: TripletBatch, number: int, precision: Precision, weight: float = 1.0) -> StepFigures:
        """Minimise the loss of a batch by one step, and say what it was before.

        Args:
            batch: Of this process.
            number: Of the step.
            precision: In which matrices are multiplied.
            weight: Of this process's loss in the mean over all processes, whose parts of a batch may differ in size.
        """
        with seeded(self.seed, number, self.device, self.rank):
            with autocast(precision, self.device):
                losses = self.losses(batch)
            figures = StepFigures(losses)
            self.backward(losses.total if weight == 1.0 else losses.total * weight)
        if self.clip_norm:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.clip_norm)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return figures
