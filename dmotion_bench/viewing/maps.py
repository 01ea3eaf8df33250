"""The feature maps of a model as pictures: tiles in one frame, all in the same unit."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

COLUMNS = 4
GAP = 3
"""Pixels between tiles, and around them."""

GAP_LEVEL = 70
BRIGHTEST = 99.9
"""Percentile of |m| over everything shown that is drawn white; what is above is white, too."""


@runtime_checkable
class MapModel(Protocol):
    """A model that describes a frame by feature maps and moves them. Images as in ``learning/model.py``."""

    def feature_maps(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b m y x"]:
        """The maps of a frame; map 0 is the agent's."""

    def moved_maps(
        self, current: Float[Tensor, "b c h w"], following: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b m y x"]:
        """The same maps, each moved as the model sees it move until the next frame."""


def brightest(*maps: Float[np.ndarray, "t m y x"]) -> float:
    """The value that is drawn white, the same for all these maps."""
    return max(max(float(np.percentile(np.abs(each), BRIGHTEST)) for each in maps), 1e-12)


def tiles(maps: Float[np.ndarray, "t m y x"], white: float) -> UInt8[np.ndarray, "t h w"]:
    """|m| of every map, ``COLUMNS`` side by side, with lines between them."""
    frames, count, height, width = maps.shape
    rows = math.ceil(count / COLUMNS)
    sheet = np.full((frames, rows * (height + GAP) + GAP, COLUMNS * (width + GAP) + GAP), GAP_LEVEL, np.uint8)
    levels = np.clip(np.abs(maps) * (255 / white), 0, 255).astype(np.uint8)
    for number, (top, left) in enumerate(tile_corners(count, height, width)):
        sheet[:, top : top + height, left : left + width] = levels[:, number]
    return sheet


def tile_corners(count: int, height: int, width: int) -> list[tuple[int, int]]:
    """Each tile's first row and column."""
    return [
        (GAP + number // COLUMNS * (height + GAP), GAP + number % COLUMNS * (width + GAP)) for number in range(count)
    ]
