"""Minimum, maximum, mean, std, count and quantiles of a feature, as LeRobot keeps them beside its data.

Exact, where LeRobot's own are estimated from a sample of pictures: bytes are counted, numbers are kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from jaxtyping import Float64, Int64, Shaped, UInt8

QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
LARGEST: Final = 2.0**400
"""The square of a larger number might be none."""
Summary = Mapping[str, list[object]]


def of_numbers(values: Shaped[np.ndarray, "n d"]) -> Summary:
    """Of numbers, for each dimension."""
    quantiles = np.quantile(values.astype(np.float64), list(QUANTILES.values()), axis=0)
    scale = _scale(values)
    scaled = values / scale if scale > 1 else values
    return {
        "min": values.min(0).tolist(),
        "max": values.max(0).tolist(),
        "mean": (scaled.mean(0, dtype=np.float64) * scale).tolist(),
        "std": (scaled.std(0, dtype=np.float64) * scale).tolist(),
        "count": [len(values)],
        **dict(zip(QUANTILES, quantiles.tolist(), strict=True)),
    }


def _scale(values: Shaped[np.ndarray, "n d"]) -> float:
    """A power of two, by which numbers can be divided without loss so that their squares are no overflow."""
    largest = float(np.abs(values.astype(np.float64)).max(initial=0.0))
    return math.ldexp(1.0, math.frexp(largest)[1] - 1) if largest > LARGEST else 1.0


class PixelCounts:
    """How often each value occurs in each colour channel."""

    def __init__(self) -> None:
        self._counts: Int64[np.ndarray, "3 256"] = np.zeros((3, 256), np.int64)
        self._frames = 0

    def add(self, frames: UInt8[np.ndarray, "t h w 3"]) -> None:
        """Count some frames."""
        for channel in range(3):
            self._counts[channel] += np.bincount(frames[..., channel].reshape(-1), minlength=256)
        self._frames += len(frames)

    def merge(self, other: PixelCounts) -> None:
        """Add what another has counted."""
        self._counts += other._counts
        self._frames += other._frames

    def summary(self) -> Summary:
        """Of the pixels as numbers in [0, 1], shaped channel x 1 x 1."""
        levels = np.arange(256) / 255
        total = self._counts.sum(1)
        mean = self._counts @ levels / total
        std = np.sqrt(np.maximum(self._counts @ levels**2 / total - mean**2, 0))
        below = self._counts.cumsum(1)
        found = {name: levels[(below < share * total[:, None]).sum(1)] for name, share in QUANTILES.items()}
        lowest, highest = levels[(below == 0).sum(1)], levels[(below < total[:, None]).sum(1)]
        values = {"min": lowest, "max": highest, "mean": mean, "std": std, **found}
        return {**{name: _by_channel(value) for name, value in values.items()}, "count": [self._frames]}


def _by_channel(values: Float64[np.ndarray, " 3"]) -> list[object]:
    return [[[float(value)]] for value in values]
