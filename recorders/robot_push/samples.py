"""The fine picture: 3x3 samples a pixel, each a colour and a mask value in one word, and windows of both pictures."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, UInt8, UInt32

SAMPLES = 3  # along each side of a pixel; odd, so that the middle one is the pixel's centre
NOTHING = np.float32(0.0)  # inverse depth of the background: infinitely far
_EVEN_BYTES = np.uint32(0x00FF00FF)  # every second channel of a paint, with room for a sum


def painted(colors: UInt8[np.ndarray, "*n 3"], labels: UInt8[np.ndarray, "*n"]) -> UInt32[np.ndarray, "*n"]:
    """Samples of these colours (RGB) and mask values: four bytes in one word, which are copied and chosen at once."""
    paints: UInt32[np.ndarray, "*n"] = np.concatenate([colors, labels[..., None]], axis=-1).view(np.uint32)[..., 0]
    return paints


def labels_of(paints: UInt32[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """The samples' mask values."""
    labels: UInt8[np.ndarray, "*n"] = paints.view(np.uint8).reshape(*paints.shape, 4)[..., 3]
    return labels


def in_samples(window: tuple[slice, slice]) -> tuple[slice, slice]:
    """A window of the picture in the fine picture."""
    rows, columns = (slice(SAMPLES * side.start, SAMPLES * side.stop) for side in window)
    return rows, columns


def bounding_window(rows: Int[np.ndarray, " n"], columns: Int[np.ndarray, " n"]) -> tuple[slice, slice]:
    """The rows and columns that some samples lie in."""
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)


def overlap(one: tuple[slice, slice], other: tuple[slice, slice]) -> tuple[slice, slice]:
    """What two windows have in common, empty where they do not meet."""
    starts = [max(mine.start, theirs.start) for mine, theirs in zip(one, other, strict=True)]
    stops = [min(mine.stop, theirs.stop) for mine, theirs in zip(one, other, strict=True)]
    rows, columns = (slice(start, max(start, stop)) for start, stop in zip(starts, stops, strict=True))
    return rows, columns


def within(part: tuple[slice, slice], whole: tuple[slice, slice]) -> tuple[slice, slice]:
    """A part of a window, counted from that window's first row and column; empty parts stay empty."""
    rows, columns = (
        slice(mine.start - theirs.start, mine.stop - theirs.start) if mine.stop > mine.start else slice(0, 0)
        for mine, theirs in zip(part, whole, strict=True)
    )
    return rows, columns


def mean_of_samples(fine: UInt32[np.ndarray, "hs ws"]) -> UInt8[np.ndarray, "h w 3"]:
    """Each pixel's mean colour over its samples, rounded."""
    half = np.uint32(SAMPLES**2 // 2 * 0x00010001)  # a sum of all samples of a channel fits in 16 bits
    means = []
    for channels in (fine & _EVEN_BYTES, fine >> np.uint32(8) & _EVEN_BYTES):
        rows = channels[0::SAMPLES]
        for row in range(1, SAMPLES):
            rows = rows + channels[row::SAMPLES]
        total = rows[:, 0::SAMPLES] + half
        for column in range(1, SAMPLES):
            total += rows[:, column::SAMPLES]
        means.append(total.view(np.uint16) // np.uint16(SAMPLES**2))
    red_blue, green = means
    frame = np.empty((*total.shape, 3), np.uint8)
    frame[..., 0::2] = red_blue.reshape(*total.shape, 2)
    frame[..., 1] = green[:, 0::2]
    return frame


def middle_labels(fine: UInt32[np.ndarray, "hs ws"]) -> UInt8[np.ndarray, "h w"]:
    """Each pixel's mask value: that of the sample at its centre."""
    middle = SAMPLES // 2
    return labels_of(np.ascontiguousarray(fine[middle::SAMPLES, middle::SAMPLES])).copy()
