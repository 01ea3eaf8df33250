"""A picture of any shape -> a square frame: cropped, padded or stretched, then averaged over areas.

Each pixel of the frame is the mean of the area that it covers of the picture, parts of pixels by their share,
so thin things fade instead of flickering. Computed in whole numbers, so it is the same on every machine.
(Pillow's box filter counts a pixel as inside or outside: on noise, 240 pixels to 128, it is off by up to 130 of 255.)
"""

from __future__ import annotations

import itertools
from enum import StrEnum

import numpy as np
from jaxtyping import Int64, Integer, UInt8


class Fit(StrEnum):
    """How a picture that is not square becomes square."""

    CROP = "crop"  # the largest square in its middle
    PAD = "pad"  # all of it, with black bars
    STRETCH = "stretch"  # all of it, out of proportion


def fitted(picture: UInt8[np.ndarray, "h w 3"], size: int, fit: Fit) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """The picture as a frame of ``size`` by ``size`` pixels."""
    height, width = picture.shape[:2]
    if fit is Fit.CROP:
        side = min(height, width)
        top, left = (height - side) // 2, (width - side) // 2
        return area_mean(picture[top : top + side, left : left + side], size, size)
    if fit is Fit.STRETCH:
        return area_mean(picture, size, size)
    longest = max(height, width)
    inner_h, inner_w = (max(1, round(side * size / longest)) for side in (height, width))
    top, left = (size - inner_h) // 2, (size - inner_w) // 2
    frame = np.zeros((size, size, 3), np.uint8)
    frame[top : top + inner_h, left : left + inner_w] = area_mean(picture, inner_h, inner_w)
    return frame


def area_mean(picture: UInt8[np.ndarray, "h w 3"], height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """The picture in another size, every pixel the mean of the area that it covers, rounded."""
    if picture.shape[:2] == (height, width):
        return np.ascontiguousarray(picture)
    source_h, source_w = picture.shape[:2]
    rows = _area_sums(picture.reshape(source_h, -1), height).reshape(height, source_w, 3)
    columns = np.ascontiguousarray(rows.swapaxes(0, 1)).reshape(source_w, -1)
    sums = _area_sums(columns, width).reshape(width, height, 3).swapaxes(0, 1)
    area = source_h * source_w
    mean: UInt8[np.ndarray, "{height} {width} 3"] = ((2 * sums + area) // (2 * area)).astype(np.uint8)
    return mean


def _area_sums(values: Integer[np.ndarray, "n m"], size: int) -> Int64[np.ndarray, "{size} m"]:
    """Sums over ``size`` equal stretches of the first axis, in units of 1 / size of an entry."""
    whole, part = np.divmod(np.arange(size + 1) * len(values), size)
    sums = np.empty((size, values.shape[1]), np.int64)
    for stretch, (start, stop) in enumerate(itertools.pairwise(whole.tolist())):
        np.add.reduce(values[start:stop], axis=0, dtype=np.int64, out=sums[stretch])
    sums *= size
    at_edges = values[np.minimum(whole, len(values) - 1)] * part[:, None]
    return sums + np.diff(at_edges, axis=0)
