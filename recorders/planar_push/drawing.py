"""Draws the flat scene, antialiased, in numpy.

A convex shape's coverage of a pixel is taken as one half minus the pixel centre's signed distance from the shape
[px], between 0 and 1. The mask has a shape where its coverage is at least one half: where the pixel's centre is in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
        paint: Colour times coverage, and a half for rounding.
        inside: Where the pixel's centre is in the shape.
    """

    window: tuple[slice, slice]
    coverage: UInt16[np.ndarray, "h w 1"]
    paint: UInt16[np.ndarray, "h w 3"]
    inside: Bool[np.ndarray, "h w"]

    def lay(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Paint it over what is there."""
        part = frame[self.window]
        part[...] = (part * (256 - self.coverage) + self.paint) >> 8


def stamp(
    view: View,
    shape: Shape,
    position: Float[np.ndarray, "2"],
    angle: float,
    color: tuple[float, float, float],
) -> Stamp | None:
    """A shape at a pose [m, rad], of a colour (RGB, 0-255); None where the picture does not reach."""
    center = view.project(position)
    radius = shape.radius * view.scale + 1.0
    left, top = (max(0, int(np.ceil(middle - radius))) for middle in center)
    right, bottom = (min(view.size, int(np.floor(middle + radius)) + 1) for middle in center)
    if left >= right or top >= bottom:
        return None
    x = np.arange(left, right) - center[0]
    y = np.arange(top, bottom) - center[1]
    if len(shape.corners):
        normals, offsets = shape.walls
        cos, sin = np.cos(angle), np.sin(angle)
        to_picture = view.matrix @ np.array([[cos, -sin], [sin, cos]]) / view.scale
        facing = normals @ to_picture.T
        distance = (facing[:, 0:1] * x)[:, None, :] + (facing[:, 1:2] * y)[:, :, None]
        distance = (distance - (offsets * view.scale)[:, None, None]).max(axis=0)
    else:
        distance = np.sqrt(x**2 + (y**2)[:, None]) - shape.radius * view.scale
    coverage = np.rint(256 * np.clip(0.5 - distance, 0.0, 1.0)).astype(np.uint16)[..., None]
    return Stamp(
        window=(slice(top, bottom), slice(left, right)),
        coverage=coverage,
        paint=coverage * np.asarray(color, np.uint16) + np.uint16(128),
        inside=distance <= 0,
    )
