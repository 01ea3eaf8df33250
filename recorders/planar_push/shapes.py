"""The flat things on the table: regular polygons, rectangles and a circle, about 15 pixels across."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A convex polygon around its centre of mass, or a circle.

    Attributes:
        corners: Counter-clockwise [m]; none for a circle.
        radius: Of the circle, or of the smallest circle around the polygon's centre [m].
    """

    corners: Float[np.ndarray, "v 2"]
    radius: float

    @cached_property
    def walls(self) -> tuple[Float[np.ndarray, "v 2"], Float[np.ndarray, " v"]]:
        """Outward unit normals of the edges, and their distances from the centre [m]."""
        along = np.roll(self.corners, -1, axis=0) - self.corners
        normals = np.stack([along[:, 1], -along[:, 0]], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return normals, np.einsum("vi,vi->v", normals, self.corners)


def circle(radius: float) -> Shape:
    """A circle of this radius [m]."""
    return Shape(corners=np.empty((0, 2)), radius=radius)


def regular(sides: int, radius: float) -> Shape:
    """A regular polygon with its corners at ``radius`` [m]."""
    turns = np.arange(sides) * 2 * np.pi / sides
    return Shape(corners=radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1), radius=radius)


def rectangle(length: float, width: float) -> Shape:
    """A rectangle with sides of these lengths [m]."""
    half = np.array([length, width]) / 2
    return Shape(corners=half * [(1, 1), (-1, 1), (-1, -1), (1, -1)], radius=float(np.hypot(*half)))


SHAPES: dict[str, Shape] = {
    "square": rectangle(0.065, 0.065),
    "circle": circle(0.037),
    "bar": rectangle(0.1, 0.05),
    "triangle": regular(3, 0.05),
    "hexagon": regular(6, 0.041),
    "pentagon": regular(5, 0.043),
}
"""Every shape by its name."""
