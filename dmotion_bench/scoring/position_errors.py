"""How far predicted objects are from where they should be, per frame [px].

The truth's centres are those that the finder finds in the true frame; an object that is not found there is left
out. Over the rest, the mean per frame:

- ``position_error_paper``: the distance between the centres; an object missing in the prediction is charged its
  distance to (-1, -1), as the paper's code does.
- ``position_error``: the same over the objects found in both frames. It says nothing about what is missing, so
  beside it stand
- ``miss_rate``: of the objects in the true frame, the share that is not found in the prediction, and
- ``false_positive_rate``: of the objects that are *not* in the true frame, the share that the prediction shows.

A frame in which a figure has no object to speak of has no value for it (NaN) and does not count in its mean.
A report's figure is the mean over frames of these per-frame values.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dmotion_bench.positions import Positions

MISSING_AT = (-1.0, -1.0)
"""Where the paper's code believes an object that it did not find [px]."""


@dataclass(frozen=True, kw_only=True)
class PositionErrors:
    """Figures of each frame; NaN where a frame has no value."""

    position_error_paper: Float[Tensor, " b"]
    position_error: Float[Tensor, " b"]
    miss_rate: Float[Tensor, " b"]
    false_positive_rate: Float[Tensor, " b"]


def position_errors(predicted: Positions, truth: Positions) -> PositionErrors:
    """Compare where things are with where they should be; axis k of both are the same things."""
    both, missed = truth.found & predicted.found, truth.found & ~predicted.found
    distance = distances(predicted, truth)
    corner = torch.tensor(MISSING_AT, device=distance.device)
    charged = torch.where(missed, torch.linalg.vector_norm(truth.centre - corner, dim=-1), distance)
    return PositionErrors(
        position_error_paper=_mean(charged, truth.found),
        position_error=_mean(distance, both),
        miss_rate=_mean(missed.float(), truth.found),
        false_positive_rate=_mean(predicted.found.float(), ~truth.found),
    )


def distances(predicted: Positions, truth: Positions) -> Float[Tensor, "b k"]:
    """Between the centres of each thing [px]; NaN unless it is found in both frames."""
    apart: Tensor = torch.linalg.vector_norm(predicted.centre - truth.centre, dim=-1)
    return apart


def first_things(positions: Positions, count: int) -> Positions:
    """The first ``count`` things alone: the objects without the agent."""
    return Positions(
        centre=positions.centre[..., :count, :],
        found=positions.found[..., :count],
        pixels=positions.pixels[..., :count],
    )


def _mean(values: Float[Tensor, "b k"], counted: Bool[Tensor, "b k"]) -> Float[Tensor, " b"]:
    """Over the things that count; NaN where none does."""
    return torch.where(counted, values, 0.0).sum(-1) / counted.sum(-1)
