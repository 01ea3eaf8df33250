"""In which precision a training multiplies matrices: bf16 or float32, whichever is faster here.

bf16 is the faster one on most processors that have it, but not on all of them. So a training that is not told which
one to take measures it: a copy of its model takes some steps in each precision, in turn, before the first real step.
Neither the model nor the optimiser nor any random number is touched, so what follows is what would have followed if
the precision had been named. What was chosen and measured stands in ``run.json`` and is kept when the run goes on.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, get_args

import torch

from dmotion_bench.learning.optimization import has_bf16

Precision = Literal["bf16", "float32"]
AUTO: Final = "auto"
PRECISIONS: Final[tuple[Precision, ...]] = get_args(Precision)
CHOICES: Final = (AUTO, *PRECISIONS)

FEWEST_STEPS: Final = 200
"""A shorter training is over before a measurement would have paid."""
FEWEST_ROUNDS: Final = 3
MOST_ROUNDS: Final = 9
SECONDS: Final = 3.0
"""After so long the fewest rounds are enough."""
MARGIN: Final = 1.05
OFTEN: Final = 0.75
"""float32 must be faster by the margin in the median and in so many of the rounds: noise is not to decide."""


@dataclass(frozen=True)
class Rounds:
    """Seconds of a step in each precision, round by round."""

    bf16: tuple[float, ...]
    float32: tuple[float, ...]

    @property
    def medians(self) -> dict[str, float]:
        """Seconds of a usual step in each precision."""
        return {"bf16": statistics.median(self.bf16), "float32": statistics.median(self.float32)}

    @property
    def faster(self) -> Precision:
        """float32 where it is clearly the faster one, else bf16."""
        won = [float32 * MARGIN < bf16 for bf16, float32 in zip(self.bf16, self.float32, strict=True)]
        clear = self.medians["float32"] * MARGIN < self.medians["bf16"]
        return "float32" if clear and sum(won) >= OFTEN * len(won) else "bf16"


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


def timed(step: Callable[[Precision], object], device: torch.device) -> Rounds:
    """Steps in each precision in turn, after one of each that does not count."""
    for precision in PRECISIONS:
        _seconds(step, precision, device)
    rounds: list[list[float]] = []
    began = time.perf_counter()
    while len(rounds) < FEWEST_ROUNDS or (len(rounds) < MOST_ROUNDS and time.perf_counter() - began < SECONDS):
        rounds.append([_seconds(step, precision, device) for precision in PRECISIONS])
    return Rounds(*zip(*rounds, strict=True))


def _seconds(step: Callable[[Precision], object], precision: Precision, device: torch.device) -> float:
    began = time.perf_counter()
    step(precision)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began
