"""What a model's state holds: a linear probe reads from it where the agent and the objects are.

A model that plans in a space of its own can only bring about what that space tells apart. The probe is a ridge
regression from the state's embedding at x_t to positions in the world. It is fitted on the training episodes, with the
penalty that reads other training episodes best, and asked on the held-out ones: their layouts are new to it.

The figure is R^2 = 1 - sum of squared errors / sum of squared distances from the mean of the rows that the probe was
fitted on: 1 where every place is read exactly, 0 for a state that tells nothing. LeWorldModel (Maes et al. 2026) and
others ask their embeddings such questions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.triplets import TripletSet
from dmotion_bench.scoring.latent_ranking import EmbeddingModel
from dmotion_bench.scoring.samples import STATE_PROBED
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.scoring.true_factors import true_places

MOST_FITTED: Final = 2_000  # triplets of the training episodes, evenly spread
FOLDS: Final = 5
PENALTIES: Final = 10.0 ** np.arange(-6, 5)
"""Times the number of rows, on embeddings in units of their standard deviations."""


def probe_states(
    model: ForwardModel[Any], held_out: HeldOut, *, batch_size: int, device: torch.device
) -> Mapping[str, Float[np.ndarray, "n 2"]]:
    """For each held-out triplet the whole and the error of each place that was probed, by its name in the samples.

    Nothing for a model without states of its own, where no place is known, and on the paper's split, whose held-out
    triplets are of the training's episodes.
    """
    if not isinstance(model, EmbeddingModel) or held_out.protocol != "episode":
        return {}
    fitted, asked = (TripletSet.of_split(held_out.dataset, name) for name in ("train", held_out.split))
    spread = np.linspace(0, len(fitted) - 1, min(len(fitted), MOST_FITTED)).round().astype(np.int64)
    fitted = fitted.subset(np.unique(spread))
    try:
        known, wanted = (true_places(held_out.dataset, one.episode, one.step) for one in (fitted, asked))
    except LabelsNotAvailable:  # of some training episodes
        return {}
    if not any(np.isfinite(places).all(axis=2).any() for places in known.values()):
        return {}
    inputs, questions = (_embedded(model, one, batch_size, device) for one in (fitted, asked))
    middle, scale = inputs.mean(0), inputs.std(0)
    scale[scale == 0] = 1
    inputs, questions = (inputs - middle) / scale, (questions - middle) / scale
    fold = np.unique(fitted.episode, return_inverse=True)[1] % FOLDS
    found = {}
    for name in STATE_PROBED:
        parts = [
            _read(inputs, known[name][:, one], fold, questions, wanted[name][:, one])
            for one in range(known[name].shape[1])
        ]
        if parts := [part for part in parts if part is not None]:
            seen: Bool[np.ndarray, " m"] = np.isfinite(np.stack(parts)).all(axis=2).any(axis=0)
            found[name] = np.where(seen[:, None], np.nansum(parts, axis=0), np.nan)
    return found


def _embedded(
    model: EmbeddingModel, triplets: TripletSet, batch_size: int, device: torch.device
) -> Float64[np.ndarray, "n d"]:
    """The embedding at the middle of each triplet."""
    found: list[Tensor] = []
    for first in range(0, len(triplets), batch_size):
        rows = np.arange(first, min(first + batch_size, len(triplets)))
        frames = torch.from_numpy(triplets.gather(rows)[:, :2]).to(device)
        state = model.begin(to_model(frames[:, 0]), to_model(frames[:, 1]))  # type: ignore[attr-defined]
        found.append(model.embedding(state).flatten(1).double().cpu())
    embedded: Float64[np.ndarray, "n d"] = torch.cat(found).numpy()
    return embedded


def _read(
    inputs: Float[np.ndarray, "n d"],
    places: Float[np.ndarray, "n 3"],
    fold: Int[np.ndarray, " n"],
    questions: Float[np.ndarray, "m d"],
    truth: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "m 2"] | None:
    """Of one thing: squared distances [m^2] of its true places from the mean, and from those that were read.

    NaN where it is not there, None if it is there in too few episodes to choose a penalty.
    """
    there = np.isfinite(places).all(axis=1)
    if len(np.unique(fold[there])) < 2:
        return None
    inputs, places, fold = inputs[there], places[there], fold[there]
    missed = np.zeros(len(PENALTIES))
    for one in np.unique(fold):
        held: Bool[np.ndarray, " n"] = fold == one
        read = _regressed(inputs[~held], places[~held], inputs[held], PENALTIES)
        missed += ((read - places[held]) ** 2).sum(axis=(1, 2))
    (read,) = _regressed(inputs, places, questions, PENALTIES[[missed.argmin()]])
    return np.stack([((truth - guess) ** 2).sum(1) for guess in (places.mean(0), read)], axis=1)


def _regressed(
    known: Float[np.ndarray, "n d"],
    places: Float[np.ndarray, "n 3"],
    asked: Float[np.ndarray, "m d"],
    penalties: Float[np.ndarray, " p"],
) -> Float[np.ndarray, "p m 3"]:
    """What the regression under each penalty reads, from the smaller of the two matrices that tell it."""
    middle, mean = known.mean(0), places.mean(0)
    known, asked, places = known - middle, asked - middle, places - mean
    if known.shape[1] <= len(known):
        values, directions = np.linalg.eigh(known.T @ known)
        along, seen = directions.T @ (known.T @ places), asked @ directions
    else:
        values, directions = np.linalg.eigh(known @ known.T)
        along, seen = directions.T @ places, (asked @ known.T) @ directions
    shrunk = 1 / (values.clip(0)[:, None] + penalties * len(known))
    read: Float[np.ndarray, "p m 3"] = mean + np.einsum("mk,kp,kd->pmd", seen, shrunk, along, optimize=True)
    return read
