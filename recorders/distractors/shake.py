"""``shake``: the camera is held by a hand, so the whole picture moves by some pixels, at most the given number.

The picture moves in whole pixels, so that every pixel that stays in it is the one that was drawn.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

from recorders.distractors.streams import Track

KEPT: Final = 0.6  # of a shift from one step to the next
PUSH: Final = 0.5  # standard deviation of what is added at each step, of the largest shift


class Shake:
    """How far the picture is moved.

    Args:
        generator: Of random numbers.
        most: Along each axis [px].
    """

    def __init__(self, generator: np.random.Generator, most: int) -> None:
        self._most = most

        def after(state: tuple[float, float]) -> tuple[float, float]:
            x, y = generator.standard_normal(2).tolist()
            return KEPT * state[0] + PUSH * x, KEPT * state[1] + PUSH * y

        self._track = Track(after((0.0, 0.0)), after)

    def at(self, moment: int) -> tuple[int, int]:
        """Along x and y [px]: +1 moves the picture to the right, or down."""
        x, y = (round(min(max(one, -1.0), 1.0) * self._most) for one in self._track.at(moment))
        return x, y

    def moved(self, before: int, after: int) -> Float[np.ndarray, "2"]:
        """How far the picture moves between two moments, along x and y [px]."""
        return np.asarray(self.at(after), np.float64) - np.asarray(self.at(before), np.float64)


def shifted(
    pixels: UInt8[np.ndarray, "h w *c"], shift: tuple[int, int], fill: int | tuple[int, int, int]
) -> UInt8[np.ndarray, "h w *c"]:
    """A picture moved by whole pixels; what comes in is ``fill``."""
    x, y = shift
    height, width = pixels.shape[:2]
    moved = np.empty_like(pixels)
    rows, columns = slice(max(0, y), height + min(0, y)), slice(max(0, x), width + min(0, x))
    moved[rows, columns] = pixels[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
    for outside in (moved[: rows.start], moved[rows.stop :], moved[:, : columns.start], moved[:, columns.stop :]):
        outside[:] = fill
    return moved


def cut_off(masks: UInt8[np.ndarray, "h w"], shift: tuple[int, int], things: int) -> Float[np.ndarray, " k"] | None:
    """The share of each thing's pixels that a shift leaves in the picture; None where it is all of all.

    Args:
        masks: 0 background, 1 the agent, 2 + k object k.
        shift: Along x and y [px].
        things: The agent and the objects.
    """
    x, y = shift
    height, width = masks.shape
    gone = [
        masks[height - y :] if y > 0 else masks[: -y or 0],
        masks[:, width - x :] if x > 0 else masks[:, : -x or 0],
    ]
    if not any(part.any() for part in gone):
        return None
    kept = shifted(masks, shift, 0)
    before, after = (np.bincount(one.reshape(-1), minlength=things + 1)[1:] for one in (masks, kept))
    left: Float[np.ndarray, " k"] = after / np.maximum(before, 1)
    return left
