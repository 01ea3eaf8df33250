"""Whether a model that predicts in a space of its own predicts the right point of it (Kipf et al. 2020, section 4.4).

A rollout ahead in that space is held against the true states of all rollouts after as many steps, by distance:

- ``hit_at_1``: 1 if its own true state is the nearest, else 0. The mean is H@1.
- ``reciprocal_rank``: 1 / the place of its own true state among all. The mean is MRR.

One that is just as near counts half a place, unless its picture is the same. So a state that is the same for all
pictures has no hit, and a board that is reached twice does no harm where a state is of one frame. A state of two frames
is another one if the frame before is another, and counts in full where it is nearer. Where there is no other state and
no other picture, as of a single rollout, there is nothing to be ranked among, and no figure. No decoder has a part in
this, so a model whose pictures are bad can be seen to know what comes, and the other way round.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.scoring.transitions import HeldOut

ROWS_AT_ONCE: Final = 1024
_EXACT: Final = "donot_use_mm_for_euclid_dist"


@runtime_checkable
class EmbeddingModel(Protocol):
    """A ``ForwardModel`` whose state has a point in a space of its own."""

    def embedding(self, state: Any) -> Float[Tensor, "b *d"]:
        """The state's point in the model's latent space."""


def can_roll_out(model: ForwardModel[Any]) -> bool:
    """Whether a model's rollouts have figures: those of frames, of states, or of both."""
    return model.needs_pixels or isinstance(model, EmbeddingModel)


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """Of each rollout after each of its steps, in the order of ``HeldOut.rollouts``; NaN where nothing is ranked."""

    hit_at_1: Float32[np.ndarray, "r t"]
    reciprocal_rank: Float32[np.ndarray, "r t"]


def rank_rollouts(
    model: ForwardModel[Any], held_out: HeldOut, *, horizon: int, batch_size: int, device: torch.device
) -> Ranks | None:
    """Roll out in the model's own space; None for a model that has none.

    Raises:
        ModelContractBroken: A state holds NaN or infinity.
    """
    if not isinstance(model, EmbeddingModel):
        return None
    imagined: list[Tensor] = []
    true: list[Tensor] = []
    shown: list[Int64[np.ndarray, "b t"]] = []
    for batch in held_out.rollouts(horizon, batch_size):
        frames = torch.from_numpy(np.concatenate([batch.previous[:, None], batch.current[:, None], batch.future], 1))
        actions = as_tensor(batch.actions, device)
        images = [to_model(frames[:, place].to(device)) for place in range(horizon + 2)]
        state = model.begin(images[0], images[1])
        steps, after = [], []
        for step in range(horizon):
            state = model.advance(state, actions[:, step])
            steps.append(embedded(model, state).double().cpu())
            after.append(embedded(model, model.begin(images[step + 1], images[step + 2])).double().cpu())
        imagined.append(torch.stack(steps, 1))
        true.append(torch.stack(after, 1))
        shown.append(np.array([[_identity(frame) for frame in frames] for frames in batch.future], np.int64))
    if not imagined:
        return Ranks(hit_at_1=np.zeros((0, horizon), np.float32), reciprocal_rank=np.zeros((0, horizon), np.float32))
    pictures = torch.from_numpy(np.concatenate(shown))
    ahead = zip(torch.cat(imagined).unbind(1), torch.cat(true).unbind(1), pictures.unbind(1), strict=True)
    rank = torch.stack([ranks(*one) for one in ahead], 1)
    hit = (rank == 1).float().masked_fill(rank.isnan(), torch.nan)
    return Ranks(hit_at_1=hit.numpy(), reciprocal_rank=rank.float().reciprocal().numpy())


def ranks(
    predicted: Float[Tensor, "n d"], true: Float[Tensor, "n d"], pictures: Int64[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """The place of each own true state among all, by the distance from the prediction: 1 is the nearest.

    NaN where all others are as near and of the same picture, so that there is nothing to be ranked among. Some rows at
    a time: the distances of all rollouts from each other may not fit into memory.

    Args:
        predicted, true: States; of one row the true one is what the predicted one should be.
        pictures: Of each true state a number that is the same for the same picture.
    """
    found = []
    for first in range(0, len(predicted), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        distance = torch.cdist(predicted[rows], true, compute_mode=_EXACT)
        own = distance.diagonal(first)[:, None]
        as_near, unlike = distance == own, pictures[rows, None] != pictures
        rank = 1 + (distance < own).sum(1).double() + (as_near & unlike).sum(1).double() / 2
        found.append(rank.masked_fill((as_near & ~unlike).all(1), torch.nan))
    return torch.cat(found) if found else predicted.new_zeros(0, dtype=torch.float64)


def embedded(model: EmbeddingModel, state: Any) -> Float[Tensor, "b d"]:
    """The embedding of a state, flat.

    Raises:
        ModelContractBroken: It holds NaN or infinity.
    """
    found = model.embedding(state).flatten(1)
    if not bool(torch.isfinite(found).all()):
        raise ModelContractBroken(f"the states of {type(model).__name__} hold NaN or infinity; its training diverged.")
    return found


def _identity(frame: UInt8[np.ndarray, "h w 3"]) -> int:
    """The same number for the same picture."""
    return int.from_bytes(hashlib.blake2b(frame.tobytes(), digest_size=8).digest(), "big", signed=True)
