"""What a training learns about its model in between: the mean losses of the validation triplets, and a picture."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8

from dmotion_bench.errors import RunError
from dmotion_bench.learning.data.curriculum import Part
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.hardware.precision import Precision, autocast
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.training.companions import Companions
from dmotion_bench.learning.training.randomness import seeded
from dmotion_bench.learning.training.samples import COLUMNS, sample_of_demonstrations, sample_of_triplets


def validation_losses(
    model: ForwardModel[Any], part: Part, companions: Companions, precision: Precision, device: torch.device
) -> dict[str, float]:
    """The losses of a part's phase, averaged over its validation triplets; each process computes its share of them.

    Args:
        model: In evaluation mode.
        part: Whose validation triplets.
        companions: The processes that train together.
        precision: In which matrices are multiplied.
        device: The model's.

    Returns:
        ``"loss"``, which is minimised, and the named terms.
    """
    sums: dict[str, float] = defaultdict(float)
    chunks = itertools.islice(
        _chunks(len(part.validation), part.order.batch_size), companions.rank, None, companions.world
    )
    for index in chunks:
        with autocast(precision, device), seeded(0, 0, device):
            losses = model.losses(part.validation(index))
        for name, value in {"loss": losses.total, **losses.terms}.items():
            sums[name] += float(value) * len(index)
    return {name: total / len(part.validation) for name, total in companions.summed(sums).items()}


def why_not_finite(model: ForwardModel[Any], loss: float, step: int) -> str:
    """Why a validation loss is no finite number: the weights are none any more, or the model fails here alone.

    Args:
        model: As it was validated.
        loss: What came out.
        step: After which.
    """
    if _are_finite(model):
        return (
            f"the validation loss is {loss} after step {step}, although all weights are finite: "
            f"{type(model).__qualname__}.losses gives no finite number in evaluation mode, or for some frames."
        )
    return (
        f"training diverged before step {step}: the loss is {loss}. "
        "Try a lower rate, such as --set learning_rate=0.0005, in a new run (--out DIR)."
    )


def require_finite(model: ForwardModel[Any], loss: float, step: int, *, validated: bool) -> None:
    """Stop a training whose validation loss is no number, or whose weights are none: no step brings them back.

    Args:
        model: As it is trained.
        loss: Of the validation, or the mean of the last steps.
        step: Of the training.
        validated: Whether it is that of the validation; of a step it may be infinite as long as the weights are finite.

    Raises:
        RunError: It is not finite.
    """
    if not math.isfinite(loss) and (validated or not _are_finite(model)):
        raise RunError(why_not_finite(model, loss, step))


def _are_finite(model: ForwardModel[Any]) -> bool:
    return all(bool(weight.isfinite().all()) for weight in model.parameters())


def validation_picture(
    model: ForwardModel[Any],
    demonstrations: Demonstrations | None,
    parts: Sequence[Part],
    precision: Precision,
    device: torch.device,
) -> UInt8[np.ndarray, "h w 3"] | None:
    """A picture of what the model predicts now, of transitions that the run has paid for; None if there are none."""
    with autocast(precision, device), seeded(0, 0, device):
        if demonstrations is not None:
            return sample_of_demonstrations(model, demonstrations)
        labelled = next((part.validation for part in parts if part.phase.needs_actions), None)
        if labelled is None:
            return None
        few = np.linspace(0, len(labelled) - 1, COLUMNS).round().astype(np.int64)
        return sample_of_triplets(model, labelled(few))


def _chunks(total: int, size: int) -> Iterator[Int[np.ndarray, " b"]]:
    """Batches of triplets from all over the set, for losses that compare the triplets of a batch."""
    count = math.ceil(total / size)
    for start in range(count):
        yield np.arange(start, total, count)
