"""The losses of a step as numbers, for the curves and for drawing hard triplets, read without holding up a GPU.

Reading a number of a GPU waits for everything that the GPU was told to do before. So the losses set out for the CPU
when the forward pass is told, and are read when the whole step is: the GPU computes gradients meanwhile.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.learning.model import Losses


class StepFigures:
    """What a step's losses were.

    Args:
        losses: Of the step; they begin to be copied to the CPU if they are elsewhere.
    """

    def __init__(self, losses: Losses) -> None:
        named = {"loss": losses.total, **losses.terms}
        self._names = tuple(named)
        self._values = _on_the_way(torch.stack([value.detach().double() for value in named.values()]))
        each = losses.per_triplet
        self._per_triplet = None if each is None else _on_the_way(each.detach().float())
        self._arrived: torch.cuda.Event | None = None
        if losses.total.device.type == "cuda":
            self._arrived = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._arrived.record()

    @property
    def terms(self) -> dict[str, float]:
        """The loss that was minimised and its terms, by name."""
        self._wait()
        return dict(zip(self._names, self._values.tolist(), strict=True))

    @property
    def per_triplet(self) -> Float[np.ndarray, " b"] | None:
        """The loss of each triplet of the batch, if the model tells."""
        self._wait()
        return None if self._per_triplet is None else self._per_triplet.numpy()

    def _wait(self) -> None:
        if self._arrived is not None:
            self._arrived.synchronize()


def _on_the_way(values: Tensor) -> Tensor:
    """A tensor of the CPU that holds the values once the GPU has come to here; the CPU does not wait."""
    if values.device.type != "cuda":
        return values
    return torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
