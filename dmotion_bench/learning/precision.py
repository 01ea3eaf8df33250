"""In which precision a training multiplies matrices: bf16 or float32, whichever is faster here.

bf16 is the faster one on most processors that have it, but not on all of them. So a training that is not told which
one to take measures it: a copy of its model takes some steps in each precision, in turn, before the first real step.
Neither the model nor the optimiser nor any random number is touched, so what follows is what would have followed if
the precision had been named. What was chosen and measured stands in ``run.json`` and is kept when the run goes on.
"""

from __future__ import annotations

from typing import Final, Literal, get_args

import torch

from dmotion_bench.learning.optimization import has_bf16

Precision = Literal["bf16", "float32"]
AUTO: Final = "auto"
PRECISIONS: Final[tuple[Precision, ...]] = get_args(Precision)
CHOICES: Final = (AUTO, *PRECISIONS)

FEWEST_STEPS: Final = 200
"""A shorter training is over before a measurement would have paid."""


def settled(asked: str, steps: int, device: torch.device) -> Precision | None:
    """The precision of a training, where nothing has to be measured; else None.

    Args:
        asked: One of ``CHOICES``.
        steps: Of the training.
        device: Where it runs.
    """
    if asked == "float32" or not has_bf16(device):
        return "float32"
    return "bf16" if asked == "bf16" or steps < FEWEST_STEPS else None
