"""What a model's state holds: a linear probe reads from it where the agent and the objects are.

A model that plans in a space of its own can only bring about what that space tells apart. The probe is a ridge
regression from the state's embedding at x_t to positions in the world. It is fitted on the training episodes, with the
penalty that reads other training episodes best, and asked on the held-out ones: their layouts are new to it.

The figure is R^2 = 1 - sum of squared errors / sum of squared distances from the mean of the rows that the probe was
fitted on: 1 where every place is read exactly, 0 for a state that tells nothing. LeWorldModel (Maes et al. 2026) and
others ask their embeddings such questions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int

from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.scoring.latent_ranking import EmbeddingModel, embedded
from dmotion_bench.scoring.samples import STATE_PROBED
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.scoring.true_factors import true_places

MOST_FITTED: Final = 2_000  # triplets of the training episodes, evenly spread
MOST_NUMBERS: Final = 512  # of a state; of a longer one so many principal components are probed
FOLDS: Final = 5
PENALTIES: Final = 10.0 ** np.arange(-6, 5)
"""Times the number of rows, on embeddings in units of their standard deviations."""


def probe_states(
    model: ForwardModel[Any], held_out: HeldOut, *, batch_size: int, device: torch.device
) -> Mapping[str, Float[np.ndarray, "n 2"]]:
    """For each held-out triplet the whole and the error of each place that was probed, by its name in the samples.

    Nothing for a model without states of its own, where no place is known, and on the paper's split, whose held-out
    triplets are of the training's episodes.

    Raises:
        ModelContractBroken: Its states hold NaN or infinity.
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
    states = _Inputs(np.concatenate(list(_embedded(model, fitted, batch_size, device))))
    fold = np.unique(fitted.episode, return_inverse=True)[1] % FOLDS
    probes = {
        name: [_fitted(states.known, places, fold) for places in known[name].transpose(1, 0, 2)]
        for name in STATE_PROBED
    }
    found = {name: np.full((len(asked), 2), np.nan) for name in STATE_PROBED if any(probes[name])}
    done = 0
    for part in _embedded(model, asked, batch_size, device):
        here, inputs = slice(done, done + len(part)), states.of(part)
        for name, columns in found.items():
            columns[here] = _summed(probes[name], inputs, wanted[name][here])
        done += len(part)
    return found


def _embedded(
    model: ForwardModel[Any], triplets: TripletSet, batch_size: int, device: torch.device
) -> Iterator[Float32[np.ndarray, "b d"]]:
    """The embedding at the middle of each triplet, batch by batch."""
    assert isinstance(model, EmbeddingModel), "others have no states to be probed"
    for first in range(0, len(triplets), batch_size):
        rows = np.arange(first, min(first + batch_size, len(triplets)))
        frames = torch.from_numpy(triplets.gather(rows)[:, :2]).to(device)
        state = model.begin(to_model(frames[:, 0]), to_model(frames[:, 1]))
        yield embedded(model, state).float().cpu().numpy()


class _Inputs:
    """What the probes are given: embeddings in units of their standard deviations, or their principal components.

    Args:
        embedded: The rows that probes are fitted on.

    Attributes:
        known: What the probes are given of these.
    """

    def __init__(self, embedded: Float32[np.ndarray, "n d"]) -> None:
        self._middle, self._scale = embedded.mean(0), embedded.std(0)
        self._scale[self._scale == 0] = 1
        self._directions: Float[np.ndarray, "d k"] | None = None
        scaled = (embedded - self._middle) / self._scale
        if scaled.shape[1] > MOST_NUMBERS:
            values, rows = np.linalg.eigh((scaled @ scaled.T).astype(np.float64))
            values, rows = values[-MOST_NUMBERS:], rows[:, -MOST_NUMBERS:]
            there = values > 1e-6 * values[-1]
            self._directions = scaled.T @ (rows[:, there] / np.sqrt(values[there])).astype(np.float32)
        self.known = self.of(embedded)

    def of(self, embedded: Float32[np.ndarray, "b d"]) -> Float64[np.ndarray, "b k"]:
        """What the probes are given of some rows."""
        scaled = (embedded - self._middle) / self._scale
        given: Float64[np.ndarray, "b k"] = scaled if self._directions is None else scaled @ self._directions
        return given.astype(np.float64)


@dataclass(frozen=True, kw_only=True)
class Probe:
    """A linear map from a state to a place, and the mean of the places that it was fitted on."""

    weights: Float64[np.ndarray, "k 3"]
    intercept: Float64[np.ndarray, "3"]
    mean: Float64[np.ndarray, "3"]

    def parts(self, inputs: Float64[np.ndarray, "b k"], truth: Float[np.ndarray, "b 3"]) -> Float64[np.ndarray, "b 2"]:
        """Squared distances [m^2] of the true places from the mean, and from those that are read; NaN for none."""
        read = inputs @ self.weights + self.intercept
        return np.stack([((truth - guess) ** 2).sum(1) for guess in (self.mean, read)], axis=1)


def _fitted(
    inputs: Float64[np.ndarray, "n k"], places: Float[np.ndarray, "n 3"], fold: Int[np.ndarray, " n"]
) -> Probe | None:
    """The probe of one thing; None if it is there in too few episodes to choose a penalty."""
    there = np.isfinite(places).all(axis=1)
    if len(np.unique(fold[there])) < 2:
        return None
    inputs, places, fold = inputs[there], places[there], fold[there]
    missed = np.zeros(len(PENALTIES))
    for one in np.unique(fold):
        held: Bool[np.ndarray, " n"] = fold == one
        weights = _regression(inputs[~held], places[~held], PENALTIES)
        read = places[~held].mean(0) + (inputs[held] - inputs[~held].mean(0)) @ weights
        missed += ((read - places[held]) ** 2).sum(axis=(1, 2))
    (weights,) = _regression(inputs, places, PENALTIES[[missed.argmin()]])
    mean = places.mean(0)
    return Probe(weights=weights, intercept=mean - inputs.mean(0) @ weights, mean=mean)


def _regression(
    inputs: Float64[np.ndarray, "n k"], places: Float[np.ndarray, "n 3"], penalties: Float[np.ndarray, " p"]
) -> Float64[np.ndarray, "p k 3"]:
    """The slopes of the ridge regression under each penalty; the means are not penalised."""
    inputs, places = inputs - inputs.mean(0), places - places.mean(0)
    values, directions = np.linalg.eigh(inputs.T @ inputs)
    along = directions.T @ (inputs.T @ places)
    shrunk = 1 / (values.clip(0) + penalties[:, None] * len(inputs))
    slopes: Float64[np.ndarray, "p k 3"] = directions @ (shrunk[:, :, None] * along)
    return slopes


def _summed(
    probes: Sequence[Probe | None], inputs: Float64[np.ndarray, "b k"], truth: Float[np.ndarray, "b things 3"]
) -> Float64[np.ndarray, "b 2"]:
    """The parts of all things that are there; NaN where none is."""
    parts = np.stack([one.parts(inputs, truth[:, place]) for place, one in enumerate(probes) if one is not None])
    there: Bool[np.ndarray, " b"] = np.isfinite(parts).all(axis=2).any(axis=0)
    return np.where(there[:, None], np.nansum(parts, axis=0), np.nan)
