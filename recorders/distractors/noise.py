"""``noise``: of the sensor, on every channel of every pixel anew, of the given standard deviation (of 255).

An episode's noise is cut out of one long row of normal numbers, at another place for every frame: to draw 49,152
numbers for each frame would take longer than to draw the frame.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float32, Int, UInt8

from recorders.distractors.streams import Track

ROW: Final = 2**19


@lru_cache(maxsize=1)
def _row() -> Float32[np.ndarray, " n"]:
    return np.random.default_rng(0xD0).standard_normal(ROW, np.float32)


class Noise:
    """The noise of an episode.

    Args:
        generator: Of random numbers.
        std: Of a channel, 0-255.
    """

    def __init__(self, generator: np.random.Generator, std: float) -> None:
        start = int(generator.integers(ROW // 2))
        part = _row()[start : start + ROW // 2]
        self._row: Int[np.ndarray, " n"] = np.rint(part * np.float32(std)).astype(np.int16)

        def drawn(_: object) -> float:
            return float(generator.random())

        self._starts = Track(drawn(None), drawn)

    def on(self, frame: UInt8[np.ndarray, "h w 3"], moment: int) -> UInt8[np.ndarray, "h w 3"]:
        """The frame as a sensor sees it."""
        start = int(self._starts.at(moment) * (len(self._row) - frame.size))
        total = frame.reshape(-1).astype(np.int16)
        total += self._row[start : start + frame.size]
        np.clip(total, 0, 255, out=total)
        noisy: UInt8[np.ndarray, "h w 3"] = total.astype(np.uint8).reshape(frame.shape)
        return noisy
