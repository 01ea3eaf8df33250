"""A convex solid as the camera sees it, drawn exactly.

A ray is inside a convex solid between the last plane that it enters and the first that it leaves, and in inverse depth
both are linear over the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt32

from recorders.robot_push.camera import Camera
from recorders.robot_push.light import Light
from recorders.robot_push.samples import NOTHING, SAMPLES, in_samples, painted
from recorders.robot_push.solids import Solid, rotation_matrix


@dataclass(frozen=True, kw_only=True)
class Sprite:
    """A solid as it looks where nothing hides it, in samples.

    Attributes:
        window: The rows and columns of the picture that it lies in [px].
        fine: The same of the fine picture.
        covered: Which samples it covers.
        count: How many these are.
        inverse_depth: [1/m].
        paints: Colours and mask value.
        label: Its mask value.
        center: Of the silhouette, x and y [px].
    """

    window: tuple[slice, slice]
    fine: tuple[slice, slice]
    covered: Bool[np.ndarray, "h w"]
    count: int
    inverse_depth: Float32[np.ndarray, "h w"]
    paints: UInt32[np.ndarray, "h w"]
    label: int
    center: tuple[float, float]


def sprite_of(
    solid: Solid,
    pose: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]],
    paint: tuple[tuple[float, float, float], int],
    camera: Camera,
    light: Light,
) -> Sprite | None:
    """A solid as a camera sees it under a light; None where it does not.

    Args:
        pose: Where it is [m], and how it is turned (x, y, z, w).
        paint: Its colour (RGB, 0-1) and its mask value.
    """
    (position, quaternion), (color, label) = pose, paint
    turn = rotation_matrix(quaternion)
    seen = camera.project(solid.corners @ turn.T + position)[:, :2]
    size = camera.size
    left, top = (min(max(int(np.floor(low)), 0), size) for low in seen.min(axis=0))
    right, bottom = (min(max(int(np.ceil(high)) + 1, 0), size) for high in seen.max(axis=0))
    if left >= right or top >= bottom:
        return None
    window = (slice(top, bottom), slice(left, right))
    fine = in_samples(window)
    rows, columns = (_axis(size)[side] for side in fine)

    normals = solid.normals @ turn.T
    planes, behind = camera.inverse_depth_planes(normals, solid.offsets + normals @ position)
    facing = behind < 0
    coefficients = planes.astype(np.float32)
    along_y = coefficients[:, 1:2] * rows + coefficients[:, 2:3]
    along_x = coefficients[:, 0:1] * columns
    shades = light.shade(np.array([color]), normals[facing])
    paints = painted(shades, np.full(len(shades), label, np.uint8))
    inverse_depth, fine_paints = nearest_plane(along_y[facing], along_x[facing], paints)
    covered = inverse_depth >= _greatest(along_y[~facing], along_x[~facing])
    count = int(np.count_nonzero(covered))
    if not count:
        return None
    return Sprite(
        window=window,
        fine=fine,
        covered=covered,
        count=count,
        inverse_depth=inverse_depth,
        paints=fine_paints,
        label=label,
        center=(float(covered.sum(axis=0) @ columns) / count, float(covered.sum(axis=1) @ rows) / count),
    )


@lru_cache
def _axis(size: int) -> Float32[np.ndarray, " n"]:
    """Where the samples of a row or a column of so many pixels lie [px]."""
    middle = (SAMPLES - 1) / 2
    places: Float32[np.ndarray, " n"] = ((np.arange(size * SAMPLES) - middle) / SAMPLES).astype(np.float32)
    return places


def nearest_plane(
    along_y: Float32[np.ndarray, "n h"], along_x: Float32[np.ndarray, "n w"], paints: UInt32[np.ndarray, " n"]
) -> tuple[Float32[np.ndarray, "h w"], UInt32[np.ndarray, "h w"]]:
    """The least of some planes' inverse depths at each sample, and the paint of the first plane that has it.

    Args:
        along_y, along_x: A plane's inverse depth is the sum of the two [1/m].
        paints: Of the planes.
    """
    least = along_y[0][:, None] + along_x[0]
    chosen = np.full(least.shape, paints[0])
    depth, less = np.empty_like(least), np.empty(least.shape, np.bool_)
    for row, column, paint in zip(along_y[1:], along_x[1:], paints[1:], strict=True):
        np.add(row[:, None], column, out=depth)
        np.less(depth, least, out=less)
        np.copyto(least, depth, where=less)
        np.copyto(chosen, paint, where=less)
    return least, chosen


def _greatest(along_y: Float32[np.ndarray, "n h"], along_x: Float32[np.ndarray, "n w"]) -> Float32[np.ndarray, "h w"]:
    """The greatest of some planes' inverse depths at each sample, and no less than that of the background."""
    greatest = np.full((along_y.shape[1], along_x.shape[1]), NOTHING)
    depth = np.empty_like(greatest)
    for row, column in zip(along_y, along_x, strict=True):
        np.add(row[:, None], column, out=depth)
        np.maximum(greatest, depth, out=greatest)
    return greatest
