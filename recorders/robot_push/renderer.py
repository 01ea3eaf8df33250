"""Draws the scene: arm, table, solids, with 3x3 samples a pixel, in numpy.

Why not Bullet's TinyRenderer: it takes 3-4 ms a picture, has no antialiasing, and tells neither how much of an
object is hidden nor what its silhouette's centre is. Here a convex solid is drawn exactly: a ray is inside
between the last plane it enters and the first that it leaves, and in inverse depth both are linear over the
picture. The arm's pose is a function of the tip, and the tip stands on a lattice, so that every pose of the arm is
rasterised once and kept; a solid that has not moved keeps its sprite.
A picture takes 1.3 ms, half of it for the solids that moved.

Light is a white lamp far away (ambient plus Lambert), without shadows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8, UInt32

from dmotion_bench.specs import MASK_AGENT, MASK_BACKGROUND
from recorders.robot_push.camera import Camera
from recorders.robot_push.solids import Solid, rotation_matrix
from recorders.table_lattice import KEPT_PLACES, Place

SAMPLES = 3  # along each side of a pixel; odd, so that the middle one is the pixel's centre
AMBIENT, DIFFUSE = 0.6, 0.5
LEVELS = 12
"""Steps between a surface that the lamp grazes and one that faces it: the arm's many facets compress a third better."""

BACKGROUND = (236, 239, 243)  # RGB
_EVEN_BYTES = np.uint32(0x00FF00FF)  # every second channel of a paint, with room for a sum
NOTHING = np.float32(0.0)  # inverse depth of the background: infinitely far


@dataclass(frozen=True, kw_only=True)
class Light:
    """A lamp far away.

    Attributes:
        direction: Toward the lamp, of any length.
    """

    direction: tuple[float, float, float] = (0.3, 0.4, 1.2)

    def shade(self, colors: Float[np.ndarray, "*n 3"], normals: Float[np.ndarray, "*n 3"]) -> UInt8[np.ndarray, "*n 3"]:
        """The colours (RGB, 0-1) of surfaces with these unit normals."""
        direction = np.asarray(self.direction) / np.linalg.norm(self.direction)
        facing = np.rint(LEVELS * np.clip(normals @ direction, 0.0, None)) / LEVELS
        brightness = AMBIENT + DIFFUSE * facing
        lit: Float[np.ndarray, "*n 3"] = np.clip(colors * brightness[..., None], 0.0, 1.0)
        shades: UInt8[np.ndarray, "*n 3"] = np.rint(255 * lit).astype(np.uint8)
        return shades


def painted(colors: UInt8[np.ndarray, "*n 3"], labels: UInt8[np.ndarray, "*n"]) -> UInt32[np.ndarray, "*n"]:
    """Samples of these colours (RGB) and mask values: four bytes in one word, which are copied and chosen at once."""
    paints: UInt32[np.ndarray, "*n"] = np.concatenate([colors, labels[..., None]], axis=-1).view(np.uint32)[..., 0]
    return paints


def labels_of(paints: UInt32[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """The samples' mask values."""
    labels: UInt8[np.ndarray, "*n"] = paints.view(np.uint8).reshape(*paints.shape, 4)[..., 3]
    return labels


@dataclass(frozen=True, kw_only=True)
class Sprite:
    """A solid as it looks where nothing hides it, in samples.

    Attributes:
        window: The rows and columns of the picture that it lies in [px].
        covered: Which samples it covers.
        count: How many these are.
        inverse_depth: [1/m].
        paints: Colours and mask value.
        label: Its mask value.
        center: Of the silhouette, x and y [px].
    """

    window: tuple[slice, slice]
    covered: Bool[np.ndarray, "h w"]
    count: int
    inverse_depth: Float32[np.ndarray, "h w"]
    paints: UInt32[np.ndarray, "h w"]
    label: int
    center: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class ArmLayer:
    """The arm in one pose before the empty table.

    Attributes:
        window: The rows and columns of the fine picture that the arm lies in.
        inverse_depth, paints: Of table and arm there.
        moving: How many samples show links that move.
        frame, masks: The finished picture of table and arm.
    """

    window: tuple[slice, slice]
    inverse_depth: Float32[np.ndarray, "h w"]
    paints: UInt32[np.ndarray, "h w"]
    moving: int
    frame: UInt8[np.ndarray, "h w 3"]
    masks: UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A finished picture and what it shows.

    Attributes:
        frame: RGB.
        masks: The mask value at each pixel's centre.
        visible: For each sprite the share of its samples that nothing hides, 0 where there is none.
        agent_visible: The same for the arm.
    """

    frame: UInt8[np.ndarray, "h w 3"]
    masks: UInt8[np.ndarray, "h w"]
    visible: Float[np.ndarray, " k"]
    agent_visible: float


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


class Renderer:
    """Draws one scene under one camera and one light.

    Args:
        camera: Where it is seen from.
        light: Where the light comes from.
        table: The table, its place [m] and its colour (RGB, 0-1).
        arm: The arm's pose for a place of the tip on the lattice.
        layers: The arm as it was drawn before under this camera and light; is added to.
    """

    def __init__(
        self,
        *,
        camera: Camera,
        light: Light,
        table: tuple[Solid, Float[np.ndarray, "3"], tuple[float, float, float]],
        arm: Callable[[Place], ArmPose],
        layers: dict[Place, ArmLayer],
    ) -> None:
        self.camera, self.light = camera, light
        self._arm, self._layers = arm, layers
        fine = camera.size * SAMPLES
        self._axis = ((np.arange(fine) - (SAMPLES - 1) / 2) / SAMPLES).astype(np.float32)  # samples in [px]
        nothing = painted(np.array([BACKGROUND], np.uint8), np.array([MASK_BACKGROUND], np.uint8))
        self._table_paints = np.full((fine, fine), nothing[0])
        self._table_depth = np.full((fine, fine), NOTHING)
        solid, place, color = table
        sprite = self.sprite(solid, place, np.array([0.0, 0.0, 0.0, 1.0]), color, MASK_BACKGROUND)
        if sprite is not None:
            window = in_samples(sprite.window)
            np.copyto(self._table_paints[window], sprite.paints, where=sprite.covered)
            np.copyto(self._table_depth[window], sprite.inverse_depth, where=sprite.covered)
        self._paints, self._depth = self._table_paints.copy(), self._table_depth.copy()

    def sprite(
        self,
        solid: Solid,
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        color: tuple[float, float, float],
        label: int,
    ) -> Sprite | None:
        """A solid at a pose [m], of a colour (RGB, 0-1) and a mask value; None where the camera does not see it."""
        turn = rotation_matrix(quaternion)
        seen = self.camera.project(solid.corners @ turn.T + position)[:, :2]
        size = self.camera.size
        left, top = (min(max(int(np.floor(low)), 0), size) for low in seen.min(axis=0))
        right, bottom = (min(max(int(np.ceil(high)) + 1, 0), size) for high in seen.max(axis=0))
        if left >= right or top >= bottom:
            return None
        window = (slice(top, bottom), slice(left, right))
        rows, columns = (self._axis[side] for side in in_samples(window))

        normals = solid.normals @ turn.T
        planes, behind = self.camera.inverse_depth_planes(normals, solid.offsets + normals @ position)
        facing = behind < 0
        coefficients = planes.astype(np.float32)
        along_y = coefficients[:, 1:2] * rows + coefficients[:, 2:3]
        along_x = coefficients[:, 0:1] * columns
        shades = self.light.shade(np.broadcast_to(color, normals[facing].shape), normals[facing])
        paints = painted(shades, np.full(len(shades), label, np.uint8))
        inverse_depth, fine_paints = nearest_plane(along_y[facing], along_x[facing], paints)
        leave = along_y[~facing][:, :, None] + along_x[~facing][:, None, :]
        covered = inverse_depth >= np.maximum(leave.max(axis=0), NOTHING)
        count = int(np.count_nonzero(covered))
        if not count:
            return None
        return Sprite(
            window=window,
            covered=covered,
            count=count,
            inverse_depth=inverse_depth,
            paints=fine_paints,
            label=label,
            center=(float(covered.sum(axis=0) @ columns) / count, float(covered.sum(axis=1) @ rows) / count),
        )

    def picture(self, place: Place, sprites: Sequence[Sprite | None], decals: Sequence[Sprite | None] = ()) -> Picture:
        """The arm with its tip at a place of the lattice, solids, and flat decals, which hide nothing but the table."""
        layer = self._layer(place)
        solids = [sprite for sprite in sprites if sprite is not None]
        flat = [decal for decal in decals if decal is not None]
        windows = [(one.window, in_samples(one.window)) for one in (*flat, *solids)]
        for _, window in windows:  # elsewhere the picture is the layer's, whatever the samples hold
            self._paints[window] = self._table_paints[window]
            self._depth[window] = self._table_depth[window]
            both = overlap(window, layer.window)
            self._paints[both] = layer.paints[within(both, layer.window)]
            self._depth[both] = layer.inverse_depth[within(both, layer.window)]
        hidden = 0  # samples of the arm behind solids
        for one, (_, window) in zip((*flat, *solids), windows, strict=True):
            nearer = one.inverse_depth > self._depth[window]
            nearer &= one.covered
            hidden += int(np.count_nonzero((labels_of(self._paints[window]) == MASK_AGENT) & nearer))
            np.copyto(self._paints[window], one.paints, where=nearer)
            if one.label != MASK_BACKGROUND:
                np.copyto(self._depth[window], one.inverse_depth, where=nearer)

        frame, masks = layer.frame.copy(), layer.masks.copy()
        for pixels, window in windows:
            paints = self._paints[window]
            frame[pixels] = mean_of_samples(paints)
            masks[pixels] = middle_labels(paints)
        visible = np.array(
            [
                np.count_nonzero(labels_of(self._paints[in_samples(one.window)]) == one.label) / one.count
                if one
                else 0.0
                for one in sprites
            ]
        )
        agent_visible = (layer.moving - hidden) / layer.moving if layer.moving else 0.0
        return Picture(frame=frame, masks=masks, visible=visible, agent_visible=agent_visible)

    def _layer(self, place: Place) -> ArmLayer:
        if place not in self._layers:
            if len(self._layers) >= KEPT_PLACES:  # with continuous actions there is no end of places
                self._layers.clear()
            triangles, colors, moving = self._arm(place)
            edges = triangles[:, 1:] - triangles[:, :1]
            normals = np.cross(edges[:, 0], edges[:, 1])
            normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
            facing = np.einsum("ni,ni->n", normals, triangles[:, 0] - self.camera.eye) < 0
            samples, depth, owners = rasterise(self.camera.project(triangles[facing]), self.camera.size)
            shown = depth > self._table_depth.reshape(-1)[samples]
            samples, depth, owners = samples[shown], depth[shown], owners[shown]
            labels = np.where(moving[facing], MASK_AGENT, MASK_BACKGROUND).astype(np.uint8)
            paints = painted(self.light.shade(colors[facing], normals[facing]), labels)[owners]
            fine, fine_depth = self._table_paints.copy(), self._table_depth.copy()
            fine.reshape(-1)[samples], fine_depth.reshape(-1)[samples] = paints, depth
            window = bounding_window(samples, fine.shape[1])
            self._layers[place] = ArmLayer(
                window=window,
                inverse_depth=fine_depth[window].copy(),
                paints=fine[window].copy(),
                moving=int((labels[owners] == MASK_AGENT).sum()),
                frame=mean_of_samples(fine),
                masks=middle_labels(fine),
            )
        return self._layers[place]


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


def in_samples(window: tuple[slice, slice]) -> tuple[slice, slice]:
    """A window of the picture in the fine picture."""
    rows, columns = (slice(SAMPLES * side.start, SAMPLES * side.stop) for side in window)
    return rows, columns


def bounding_window(samples: Int[np.ndarray, " n"], width: int) -> tuple[slice, slice]:
    """The rows and columns that some samples lie in, given as flat numbers in a picture of this width."""
    if not len(samples):
        return slice(0, 0), slice(0, 0)
    rows, columns = np.divmod(samples, width)
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
    extent = np.maximum(high - low, 0)
    counts = extent[:, 0] * extent[:, 1]
    owner = np.repeat(np.arange(len(triangles)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x = low[owner, 0] + within % extent[owner, 0]
    y = low[owner, 1] + within // extent[owner, 0]

    first, along, across = points[:, 0], points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    area = np.where(np.abs(area) < 1e-9, np.inf, area)  # seen edge-on: covers nothing
    from_x, from_y = x - first[owner, 0], y - first[owner, 1]
    second = (from_x * across[owner, 1] - from_y * across[owner, 0]) / area[owner]
    third = (from_y * along[owner, 0] - from_x * along[owner, 1]) / area[owner]
    inside = (second >= 0) & (third >= 0) & (second + third <= 1) & np.isfinite(area[owner])
    owner, second, third = owner[inside], second[inside], third[inside]
    corner = triangles[owner, :, 2]
    depth = corner[:, 0] + second * (corner[:, 1] - corner[:, 0]) + third * (corner[:, 2] - corner[:, 0])

    nearest = np.argsort(depth, kind="stable")  # of repeated samples the last one written stays: the nearest
    sample = (y * fine + x)[inside]
    last = np.full(fine * fine, -1, np.int64)
    last[sample[nearest]] = nearest
    samples = np.flatnonzero(last >= 0)
    winner = last[samples]
    return samples, depth[winner].astype(np.float32), owner[winner]
