"""The things on the table: convex solids, given by their corners and their faces' planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A convex solid around its own origin, standing upright.

    Attributes:
        corners: [m].
        normals: Outward unit normals of the faces.
        offsets: Each face's distance from the origin along its normal [m].
    """

    corners: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "f 3"]
    offsets: Float[np.ndarray, " f"]

    @property
    def height(self) -> float:
        """[m]."""
        return float(np.ptp(self.corners[:, 2]))

    @property
    def radius(self) -> float:
        """Of the upright solid's smallest circle around its axis, seen from above [m]."""
        return float(np.hypot(self.corners[:, 0], self.corners[:, 1]).max())


def rotation_matrix(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Of a unit quaternion x y z w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def prism(sides: int, radius: float, height: float) -> Solid:
    """An upright prism over a regular polygon with its corners at ``radius`` [m]."""
    turns = np.arange(sides) * 2 * np.pi / sides
    ring = radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    corners = np.concatenate([np.c_[ring, np.full(sides, z)] for z in (-height / 2, height / 2)])
    middles = turns + np.pi / sides
    walls = np.stack([np.cos(middles), np.sin(middles), np.zeros(sides)], axis=-1)
    normals = np.concatenate([walls, [[0, 0, 1], [0, 0, -1]]])
    offsets = np.concatenate([np.full(sides, radius * np.cos(np.pi / sides)), [height / 2] * 2])
    return Solid(corners=corners, normals=normals, offsets=offsets)


def box(x: float, y: float, z: float) -> Solid:
    """A box with edges of these lengths [m]."""
    half = np.array([x, y, z]) / 2
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    return Solid(corners=signs * half, normals=normals, offsets=np.tile(half, 2))


SOLIDS: dict[str, Solid] = {
    "cube": box(0.063, 0.063, 0.063),
    "cylinder": prism(24, 0.032, 0.08),
    "bar": box(0.098, 0.053, 0.053),
    "triangle": prism(3, 0.046, 0.053),
    "hexagon": prism(6, 0.038, 0.08),
    "slab": box(0.077, 0.077, 0.05),
}
"""Every shape by its name, about 7 cm large: 13 to 17 pixels of a 128-pixel picture."""
