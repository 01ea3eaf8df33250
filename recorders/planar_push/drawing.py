"""Draws the flat scene, antialiased, in numpy.

A convex shape's coverage of a pixel is taken as one half minus the pixel centre's signed distance from the shape
[px], between 0 and 1. The mask has a shape where its coverage is at least one half: where the pixel's centre is in it.

Distances are computed in 1/256 px, which rounds as pixels do, and a picture's row is painted as one row of numbers:
an inner loop over three channels would take most of the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from recorders.planar_push.shapes import Shape


@dataclass(frozen=True, kw_only=True)
class View:
    """Straight down on the table's middle.

    Attributes:
        size: Height and width of the picture [px].
        scale: [px/m].
        turn: Of the camera, about its axis [deg].
    """

    size: int = 128
    scale: float = 200.0
    turn: float = 0.0

    @cached_property
    def line(self) -> Float[np.ndarray, " w"]:
        """The pixels of a row or a column, in 1/256 px."""
        line: Float[np.ndarray, " w"] = 256.0 * np.arange(self.size)
        return line

    @cached_property
    def matrix(self) -> Float[np.ndarray, "2 2"]:
        """From the world's x, y [m] to the picture's, right and down, from its middle [px]."""
        cos, sin = np.cos(np.deg2rad(self.turn)), np.sin(np.deg2rad(self.turn))
        matrix: Float[np.ndarray, "2 2"] = self.scale * np.array([[cos, sin], [sin, -cos]])
        return matrix

    def project(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """World [m] to picture [px]."""
        pixels: Float[np.ndarray, "*n 2"] = points @ self.matrix.T + (self.size - 1) / 2
        return pixels


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """A shape as it looks at a pose.

    Attributes:
        window: The rows and columns that it lies in.
        coverage: Of each pixel, 0-256.
        kept: What is kept of each channel of what is there, 0-256.
        paint: Colour times coverage, and a half for rounding.
        inside: Where the pixel's centre is in the shape.
    """

    window: tuple[slice, slice]
    coverage: UInt16[np.ndarray, "h w"]
    kept: UInt16[np.ndarray, "h w*3"]
    paint: UInt16[np.ndarray, "h w*3"]
    inside: Bool[np.ndarray, "h w"]

    def lay(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Paint it over what is there."""
        rows, columns = self.window
        part = frame.reshape(len(frame), -1)[rows, 3 * columns.start : 3 * columns.stop]
        mixed = part * self.kept
        mixed += self.paint
        mixed >>= 8
        part[...] = mixed


def stamp(
    view: View,
    shape: Shape,
    position: Float[np.ndarray, "2"],
    angle: float,
    color: tuple[float, float, float],
) -> Stamp | None:
    """A shape at a pose [m, rad], of a colour (RGB, 0-255); None where the picture does not reach."""
    area = window(view, position, shape.radius)
    if area is None:
        return None
    distance = signed_distance(view, shape, position, angle, area)
    inside = distance <= 0
    return painted(area, covered(distance), inside, color, view.size)


def window(view: View, position: Float[np.ndarray, "2"], radius: float) -> tuple[slice, slice] | None:
    """The rows and columns within a radius [m] of a place [m]; None where the picture does not reach."""
    center: list[float] = view.project(position).tolist()
    reach = radius * view.scale + 1.0
    left, top = (max(0, math.ceil(middle - reach)) for middle in center)
    right, bottom = (min(view.size, math.floor(middle + reach) + 1) for middle in center)
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def signed_distance(
    view: View, shape: Shape, position: Float[np.ndarray, "2"], angle: float, area: tuple[slice, slice]
) -> Float[np.ndarray, "h w"]:
    """How far outside of a shape at a pose [m, rad] the pixels' centres are, in 1/256 px."""
    center: list[float] = view.project(position).tolist()
    rows, columns = area
    x = view.line[columns] - 256 * center[0]
    y = view.line[rows] - 256 * center[1]
    if len(shape.corners):
        normals, offsets = shape.walls
        cos, sin = math.cos(angle), math.sin(angle)
        facing = normals @ (view.matrix @ [[cos, -sin], [sin, cos]] / view.scale).T
        across = facing[:, 0:1] * x - (256 * view.scale * offsets)[:, None]
        distance: Float[np.ndarray, "h w"] = (across[:, None, :] + (facing[:, 1:2] * y)[:, :, None]).max(axis=0)
    else:
        distance = np.sqrt(x**2 + (y**2)[:, None])
        distance -= 256 * view.scale * shape.radius
    return distance


def covered(distance: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """How much of each pixel a shape covers, 0-256, by its signed distance [1/256 px], which is overwritten."""
    share = np.subtract(128, distance, out=distance)
    np.maximum(share, 0, out=share)
    np.minimum(share, 256, out=share)
    coverage: UInt16[np.ndarray, "h w"] = np.rint(share, out=share).astype(np.uint16)
    return coverage


def painted(
    area: tuple[slice, slice],
    coverage: UInt16[np.ndarray, "h w"],
    inside: Bool[np.ndarray, "h w"],
    color: tuple[float, float, float],
    size: int,
) -> Stamp:
    """A stamp of a colour (RGB, 0-255) for a picture of a width [px]."""
    channels = coverage.repeat(3, axis=1)
    paint = channels * _row_of(color, size)[: channels.shape[1]]
    paint += np.uint16(128)
    return Stamp(window=area, coverage=coverage, kept=np.uint16(256) - channels, paint=paint, inside=inside)


@lru_cache(maxsize=64)
def _row_of(color: tuple[float, float, float], size: int) -> UInt16[np.ndarray, "w*3"]:
    """A row of the picture in one colour."""
    return np.tile(np.asarray(color, np.uint16), size)
