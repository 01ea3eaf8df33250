"""A picture of any shape -> a square frame: cropped, padded or stretched, then averaged over areas.

Shrinking is an exact area average (each output pixel is the mean of the input it covers, parts of pixels by
their share), so thin things fade instead of flickering. Growing is bilinear.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from jaxtyping import UInt8
from PIL import Image


class Fit(StrEnum):
    """What becomes of a picture that is not square."""

    CROP = "crop"  # the largest square in its middle
    PAD = "pad"  # all of it, with black bars
    STRETCH = "stretch"  # all of it, out of proportion


def fitted(picture: UInt8[np.ndarray, "h w 3"], size: int, fit: Fit) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """The picture as a frame of ``size`` by ``size`` pixels."""
    height, width = picture.shape[:2]
    if (height, width) == (size, size):
        return np.ascontiguousarray(picture)
    if fit is Fit.CROP:
        side = min(height, width)
        top, left = (height - side) // 2, (width - side) // 2
        return _resized(picture[top : top + side, left : left + side], size, size)
    if fit is Fit.STRETCH:
        return _resized(picture, size, size)
    longest = max(height, width)
    inner_h, inner_w = (max(1, round(side * size / longest)) for side in (height, width))
    top, left = (size - inner_h) // 2, (size - inner_w) // 2
    frame = np.zeros((size, size, 3), np.uint8)
    frame[top : top + inner_h, left : left + inner_w] = _resized(picture, inner_h, inner_w)
    return frame


def _resized(picture: UInt8[np.ndarray, "h w 3"], height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    image = Image.fromarray(np.ascontiguousarray(picture))
    for target in ((width, image.height), (width, height)):  # the axes apart: one may shrink while the other grows
        grows = target[0] > image.width or target[1] > image.height
        image = image.resize(target, Image.Resampling.BILINEAR if grows else Image.Resampling.BOX)
    return np.array(image)
