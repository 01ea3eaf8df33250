"""The feature maps of a model as pictures: tiles in one frame."""

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
"""Percentile of a map's |m| that is drawn white; what is above is white, too."""

LEAST = 0.03
"""Of the brightest map's white: the least that another map's white can be."""


@runtime_checkable
class MapModel(Protocol):
    """A model that describes a frame by feature maps and moves them. Images as in ``learning/model.py``."""

    def feature_maps(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b m y x"]:
        """The maps of a frame; map 0 is the agent's."""

    def moved_maps(
        self, current: Float[Tensor, "b c h w"], following: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b m y x"]:
        """The same maps, each moved as the model sees it move until the next frame."""


def brightest(*sheets: Float[np.ndarray, "t m y x"]) -> Float[np.ndarray, " m"]:
    """The value that is drawn white, one for each map, the same at all times and in all these sheets.

    The scale of a map means nothing, as what reads it may multiply by anything; but maps that are next to nothing
    beside the others are left dark.
    """
    of_each = np.max([np.percentile(np.abs(maps), BRIGHTEST, axis=(0, 2, 3)) for maps in sheets], axis=0)
    white: Float[np.ndarray, " m"] = np.maximum(of_each, max(float(of_each.max()) * LEAST, 1e-12))
    return white


def tiles(maps: Float[np.ndarray, "t m y x"], white: Float[np.ndarray, " m"]) -> UInt8[np.ndarray, "t h w"]:
    """|m| of every map, ``COLUMNS`` side by side, with lines between them."""
    frames, count, height, width = maps.shape
    rows = math.ceil(count / COLUMNS)
    sheet = np.full((frames, rows * (height + GAP) + GAP, COLUMNS * (width + GAP) + GAP), GAP_LEVEL, np.uint8)
    levels = np.clip(np.abs(maps) * (255 / white)[:, None, None], 0, 255).astype(np.uint8)
    for number, (top, left) in enumerate(tile_corners(count, height, width)):
        sheet[:, top : top + height, left : left + width] = levels[:, number]
    return sheet


def tile_corners(count: int, height: int, width: int) -> list[tuple[int, int]]:
    """Each tile's first row and column."""
    return [
        (GAP + number // COLUMNS * (height + GAP), GAP + number % COLUMNS * (width + GAP)) for number in range(count)
    ]
