"""Episodes of an import that show what a run was trained on, told by their pictures alone.

An import has no seeds: a data set that was exported and imported again, cut or compressed anew, looks like any other.
So a few frames of each held-out episode are looked for among all frames of the training, both reduced to a grid of
mean colours. The distance to the nearest frame says little by itself: two recordings of one table are alike. A copy
shows by its nearest frame being much nearer than the nearest one of any other training episode. Measured:
docs/decisions/047-copies-are-told-by-their-pictures.md.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from dmotion_bench.storage.dataset import Dataset

CELLS: Final = 8  # a side of the grid
LOOKED_AT: Final = 5  # frames of a held-out episode, spread evenly
NEARER: Final = 0.3
"""A frame is a copy if its distance to the nearest frame is at most this share of that to any other episode's."""


def copied_episodes(own: Dataset, trained: Sequence[int], other: Dataset, asked: Sequence[int]) -> list[int]:
    """The episodes of a data set that were taken from the training, most of whose looked-at frames are copies.

    Args:
        own: The data set of the training.
        trained: The episodes that were trained or validated on.
        other: Of frames of the same size.
        asked: Episodes of it; of none, as of the test of an import of one episode, none is a copy.
    """
    if not len(asked):
        return []
    named = (own.path, own.fingerprint, tuple(trained), other.path, other.fingerprint, tuple(asked))
    return list(_copied_episodes(*named))


@functools.lru_cache(maxsize=8)  # many runs are scored on one import
def _copied_episodes(
    own: Path, _of_own: str, trained: tuple[int, ...], other: Path, _of_other: str, asked: tuple[int, ...]
) -> tuple[int, ...]:
    training, foreign = Dataset.open(own), Dataset.open(other)
    looked_at = [_spread(_grids(foreign.video(episode))) for episode in asked]
    copies = _are_copies(np.concatenate(looked_at), (_grids(training.video(episode)) for episode in trained))
    parts = np.split(copies, np.cumsum([len(one) for one in looked_at])[:-1])
    return tuple(episode for episode, part in zip(asked, parts, strict=True) if 2 * part.sum() > len(part))


def _spread(grids: Float64[np.ndarray, "t d"]) -> Float64[np.ndarray, "n d"]:
    return grids[np.unique(np.linspace(0, len(grids) - 1, LOOKED_AT).round().astype(np.int64))]


def _are_copies(
    frames: Float64[np.ndarray, "n d"], episodes: Iterable[Float64[np.ndarray, "t d"]]
) -> Bool[np.ndarray, " n"]:
    """Whether each frame is found in one episode, and nothing like it in the others."""
    nearest, second = (np.full(len(frames), np.inf) for _ in range(2))
    length = (frames**2).sum(1)[:, None]
    for episode in episodes:
        squared = length + (episode**2).sum(1) - 2 * frames @ episode.T  # of large frames rounded, even to below zero
        here: Float[np.ndarray, " n"] = np.linalg.norm(frames - episode[squared.argmin(1)], axis=1)  # 0 of a copy
        second = np.where(here < nearest, nearest, np.minimum(second, here))
        nearest = np.minimum(nearest, here)
    second[np.isinf(second)] = 0.0  # one episode alone: nothing to compare with, so only what is equal is a copy
    copied: Bool[np.ndarray, " n"] = nearest <= NEARER * second
    return copied


def _grids(frames: UInt8[np.ndarray, "t h w 3"]) -> Float64[np.ndarray, "t d"]:
    """Each frame as the sums of its pixels over the cells of a grid."""
    count, height, width, _ = frames.shape
    rows, columns = _cells(height), _cells(width)
    by_row = np.matmul(rows, frames.reshape(count, height, width * 3), dtype=np.float32)
    sums = np.einsum("trwc,qw->trqc", by_row.reshape(count, len(rows), width, 3), columns, optimize=True)
    grids: Float64[np.ndarray, "t d"] = sums.reshape(count, -1).astype(np.float64)
    return grids


def _cells(side: int) -> Float[np.ndarray, "n side"]:
    """Which pixels of a side lie in each cell, as 0 and 1."""
    number = min(CELLS, side)
    cell = np.arange(side) * number // side
    return np.equal(cell, np.arange(number)[:, None]).astype(np.float32)
