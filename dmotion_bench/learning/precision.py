"""In which precision a training multiplies matrices: bf16 or float32, whichever is faster here.

bf16 is the faster one on most processors that have it, but not on all of them. So a training that is not told which
one to take measures it: a copy of its model takes some steps in each precision, in turn, before the first real step.
Neither the model nor the optimiser nor any random number is touched, so what follows is what would have followed if
the precision had been named. What was chosen and measured stands in ``run.json`` and is kept when the run goes on.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Final, Literal, get_args

import torch

from dmotion_bench.learning.optimization import has_bf16

Precision = Literal["bf16", "float32"]
AUTO: Final = "auto"
CHOICES: Final = (AUTO, *get_args(Precision))

FEWEST_STEPS: Final = 200
"""A shorter training is over before a measurement would have paid."""
ROUNDS: Final = 5
SECONDS: Final = 3.0
"""No further round is begun after so long."""
MARGIN: Final = 1.05
"""float32 must be faster by so much: where the two are alike, noise is not to decide."""


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


def timed(step: Callable[[Precision], object], device: torch.device) -> dict[Precision, float]:
    """The median seconds of a step in each precision, after one of each that does not count."""
    taken: dict[Precision, list[float]] = {"bf16": [], "float32": []}
    for precision in taken:
        _seconds(step, precision, device)
    began = time.perf_counter()
    for _ in range(ROUNDS):
        for precision, seconds in taken.items():
            seconds.append(_seconds(step, precision, device))
        if time.perf_counter() - began > SECONDS:
            break
    return {precision: statistics.median(seconds) for precision, seconds in taken.items()}


def faster(seconds: Mapping[Precision, float]) -> Precision:
    """float32 where it is clearly the faster one, else bf16."""
    return "float32" if seconds["float32"] * MARGIN < seconds["bf16"] else "bf16"


def _seconds(step: Callable[[Precision], object], precision: Precision, device: torch.device) -> float:
    began = time.perf_counter()
    step(precision)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began
