"""The arm before the empty table: its triangles, rasterised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8, UInt32

from dmotion_bench.specs import MASK_AGENT, MASK_BACKGROUND
from recorders.robot_push.camera import Camera
from recorders.robot_push.light import Light
from recorders.robot_push.samples import SAMPLES, bounding_window, mean_of_samples, middle_labels, painted


class ArmPose(NamedTuple):
    """The arm's triangles somewhere.

    Attributes:
        triangles: [m].
        colors: RGB, 0-1.
        moving: Which belong to links that move; the others are scenery.
    """

    triangles: Float[np.ndarray, "n 3 3"]
    colors: Float[np.ndarray, "n 3"]
    moving: Bool[np.ndarray, " n"]


@dataclass(frozen=True, kw_only=True)
class ArmLayer:
    """The arm in one pose before the empty table.

    Attributes:
        window: The rows and columns of the fine picture that the arm lies in.
        inverse_depth, paints: Of table and arm there.
        moving: How many samples show links that move.
        touched: Which pixels of the picture have a sample of the arm.
        frame, masks: The finished picture of table and arm.
    """

    window: tuple[slice, slice]
    inverse_depth: Float32[np.ndarray, "h w"]
    paints: UInt32[np.ndarray, "h w"]
    moving: int
    touched: Bool[np.ndarray, "size size"]
    frame: UInt8[np.ndarray, "h w 3"]
    masks: UInt8[np.ndarray, "h w"]


def arm_layer(
    pose: ArmPose,
    camera: Camera,
    light: Light,
    table: tuple[UInt32[np.ndarray, "hs ws"], Float32[np.ndarray, "hs ws"]],
) -> ArmLayer:
    """The arm in a pose, before the samples of a table: their paints and inverse depths."""
    triangles, colors, moving = pose
    edges = triangles[:, 1:] - triangles[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    facing = np.einsum("ni,ni->n", normals, triangles[:, 0] - camera.eye) < 0
    samples, depth, owners = rasterise(camera.project(triangles[facing]), camera.size)
    shown = depth > table[1].reshape(-1)[samples]
    samples, depth, owners = samples[shown], depth[shown], owners[shown]
    labels = np.where(moving[facing], MASK_AGENT, MASK_BACKGROUND).astype(np.uint8)
    paints = painted(light.shade(colors[facing], normals[facing]), labels)[owners]
    fine, fine_depth = (samples_of_table.copy() for samples_of_table in table)
    fine.reshape(-1)[samples], fine_depth.reshape(-1)[samples] = paints, depth
    rows, columns = np.divmod(samples, fine.shape[1])
    window = bounding_window(rows, columns)
    touched = np.zeros((camera.size, camera.size), np.bool_)
    touched[rows // SAMPLES, columns // SAMPLES] = True
    return ArmLayer(
        window=window,
        inverse_depth=fine_depth[window].copy(),
        paints=fine[window].copy(),
        moving=int((labels[owners] == MASK_AGENT).sum()),
        touched=touched,
        frame=mean_of_samples(fine),
        masks=middle_labels(fine),
    )


def rasterise(
    triangles: Float[np.ndarray, "n 3 3"], size: int
) -> tuple[Int[np.ndarray, " m"], Float32[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Which samples triangles cover, given as picture x, y [px] and inverse depth of their corners.

    Returns:
        The covered samples (flat, each once), the nearest triangle's inverse depth there [1/m], and its number.
    """
    fine = size * SAMPLES
    points = triangles[..., :2] * SAMPLES + (SAMPLES - 1) / 2  # in samples
    low = np.clip(np.ceil(points.min(axis=1)), 0, fine).astype(np.int64)
    high = np.clip(np.floor(points.max(axis=1)) + 1, 0, fine).astype(np.int64)
    first, along, across = points[:, 0], points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    extent = np.where(np.abs(area)[:, None] < 1e-9, 0, np.maximum(high - low, 0))  # seen edge-on: covers nothing

    # Every row of a triangle's box, then every sample of a row: what is alike in a row is computed once.
    owner = np.repeat(np.arange(len(triangles)), extent[:, 1])
    y = _counted(low[:, 1], extent[:, 1])
    width, from_y = extent[owner, 0], y - first[owner, 1]
    x = _counted(low[owner, 0], width)
    from_x, areas = x - np.repeat(first[owner, 0], width), np.repeat(area[owner], width)
    second = from_x * np.repeat(across[owner, 1], width) - np.repeat(from_y * across[owner, 0], width)
    third = np.repeat(from_y * along[owner, 0], width) - from_x * np.repeat(along[owner, 1], width)
    second /= areas
    third /= areas
    inside = np.flatnonzero((second >= 0) & (third >= 0) & (second + third <= 1))
    row = np.repeat(np.arange(len(width)), width)[inside]
    second, third, owner, sample = second[inside], third[inside], owner[row], (y * fine)[row] + x[inside]
    corner = triangles[owner, :, 2]
    depth = corner[:, 0] + second * (corner[:, 1] - corner[:, 0]) + third * (corner[:, 2] - corner[:, 0])

    order = np.argsort(depth)  # of repeated samples the last one written stays: the nearest
    nearest = np.zeros(fine * fine)
    nearest[sample[order]] = depth[order]
    winners = np.flatnonzero(depth == nearest[sample])
    last = np.full(fine * fine, -1, np.int64)  # of equally near triangles the last one
    last[sample[winners]] = winners
    samples = np.flatnonzero(last >= 0)
    winner = last[samples]
    return samples, depth[winner].astype(np.float32), owner[winner]


def _counted(starts: Int[np.ndarray, " n"], counts: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """So many whole numbers from each start on, one series after the other."""
    before = np.cumsum(counts) - counts
    numbers: Int[np.ndarray, " m"] = np.arange(counts.sum()) + np.repeat(starts - before, counts)
    return numbers
