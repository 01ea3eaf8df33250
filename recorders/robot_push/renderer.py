"""Draws the scene: arm, table, solids, with 3x3 samples a pixel, in numpy.

Why not Bullet's TinyRenderer: it takes 3-4 ms a picture, has no antialiasing, and tells neither how much of an
object is hidden nor what its silhouette's centre is. Here a convex solid is drawn exactly: a ray is inside
between the last plane it enters and the first that it leaves, and in inverse depth both are linear over the
picture. The arm's pose is a function of the tip, and the tip stands on a lattice, so that every pose of the arm is
rasterised once and kept; a solid that has not moved keeps its sprite. A picture takes 0.5 ms.

Light is a white lamp far away (ambient plus Lambert), without shadows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from dmotion_bench.specs import MASK_AGENT, MASK_BACKGROUND
from recorders.robot_push.camera import Camera
from recorders.robot_push.solids import Solid, rotation_matrix
from recorders.table_lattice import Place

SAMPLES = 3  # along each side of a pixel; odd, so that the middle one is the pixel's centre
AMBIENT, DIFFUSE = 0.6, 0.5

BACKGROUND = (236, 239, 243)  # RGB
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
        brightness = AMBIENT + DIFFUSE * np.clip(normals @ direction, 0.0, None)
        lit: Float[np.ndarray, "*n 3"] = np.clip(colors * brightness[..., None], 0.0, 1.0)
        shades: UInt8[np.ndarray, "*n 3"] = np.rint(255 * lit).astype(np.uint8)
        return shades


@dataclass(frozen=True, kw_only=True)
class Sprite:
    """A solid as it looks where nothing hides it, in samples.

    Attributes:
        window: The rows and columns of the fine picture that it lies in.
        covered: Which samples it covers.
        inverse_depth: [1/m].
        colors: RGB.
        center: Of the silhouette, x and y [px].
    """

    window: tuple[slice, slice]
    covered: Bool[np.ndarray, "h w"]
    inverse_depth: Float32[np.ndarray, "h w"]
    colors: UInt8[np.ndarray, "h w 3"]
    center: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class ArmLayer:
    """The arm in one pose before the empty table, in samples and in pixels.

    Attributes:
        samples: The fine picture's samples that show the arm, flat.
        inverse_depth, colors: Of those samples.
        picture: Table and arm, the finished picture.
    """

    samples: Int[np.ndarray, " n"]
    inverse_depth: Float32[np.ndarray, " n"]
    colors: UInt8[np.ndarray, "n 3"]
    picture: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A finished picture and what it shows.

    Attributes:
        frame: RGB.
        masks: The mask value at each pixel's centre.
        visible: For each solid the share of its samples that nothing hides.
        agent_visible: The same for the arm.
    """

    frame: UInt8[np.ndarray, "h w 3"]
    masks: UInt8[np.ndarray, "h w"]
    visible: Float[np.ndarray, " k"]
    agent_visible: float


class Renderer:
    """Draws one scene under one camera and one light.

    Args:
        camera: Where it is seen from.
        light: Where the light comes from.
        table: The table, its place [m] and its colour (RGB, 0-1).
        arm: The arm's triangles [m] and their colours (RGB, 0-1) for a tip on the lattice.
        layers: The arm as it was drawn before under this camera and light; is added to.
    """

    def __init__(
        self,
        *,
        camera: Camera,
        light: Light,
        table: tuple[Solid, Float[np.ndarray, "3"], tuple[float, float, float]],
        arm: Callable[[Place], tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]],
        layers: dict[Place, ArmLayer],
    ) -> None:
        self.camera, self.light = camera, light
        self._arm, self._layers = arm, layers
        fine = camera.size * SAMPLES
        self._axis = ((np.arange(fine) - (SAMPLES - 1) / 2) / SAMPLES).astype(np.float32)  # samples in [px]
        self._colors = np.empty((fine, fine, 3), np.uint8)
        self._depth = np.empty((fine, fine), np.float32)
        self._labels = np.empty((fine, fine), np.uint8)

        self._table_colors = np.empty_like(self._colors)
        self._table_colors[:] = BACKGROUND
        self._table_depth = np.full_like(self._depth, NOTHING)
        solid, place, color = table
        sprite = self.sprite(solid, place, np.array([0.0, 0.0, 0.0, 1.0]), color)
        if sprite is not None:
            np.copyto(self._table_colors[sprite.window], sprite.colors, where=sprite.covered[..., None])
            np.copyto(self._table_depth[sprite.window], sprite.inverse_depth, where=sprite.covered)

    def sprite(
        self,
        solid: Solid,
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        color: tuple[float, float, float],
    ) -> Sprite | None:
        """A solid at a pose [m], of a colour (RGB, 0-1); None where the camera does not see it."""
        turn = rotation_matrix(quaternion)
        seen = self.camera.project(solid.corners @ turn.T + position)
        size = self.camera.size
        left, top = np.clip(np.floor(seen[:, :2].min(axis=0)), 0, size).astype(int)
        right, bottom = np.clip(np.ceil(seen[:, :2].max(axis=0)) + 1, 0, size).astype(int)
        if left >= right or top >= bottom:
            return None
        window = (slice(SAMPLES * top, SAMPLES * bottom), slice(SAMPLES * left, SAMPLES * right))
        rows, columns = self._axis[window[0]], self._axis[window[1]]

        normals = solid.normals @ turn.T
        planes, behind = self.camera.inverse_depth_planes(normals, solid.offsets + normals @ position)
        facing = behind < 0
        coefficients = planes.astype(np.float32)
        along_y = coefficients[:, 1:2] * rows + coefficients[:, 2:3]
        along_x = coefficients[:, 0:1] * columns
        enter = along_y[facing][:, :, None] + along_x[facing][:, None, :]
        leave = along_y[~facing][:, :, None] + along_x[~facing][:, None, :]
        inverse_depth = enter.min(axis=0)
        covered = inverse_depth >= np.maximum(leave.max(axis=0), NOTHING)
        count = int(covered.sum())
        if not count:
            return None
        shades = self.light.shade(np.broadcast_to(color, normals[facing].shape), normals[facing])
        center = (float(covered.sum(axis=0) @ columns) / count, float(covered.sum(axis=1) @ rows) / count)
        return Sprite(
            window=window,
            covered=covered,
            inverse_depth=inverse_depth,
            colors=shades[enter.argmin(axis=0)],
            center=center,
        )

    def picture(
        self, place: Place, sprites: Sequence[tuple[Sprite | None, int]], decals: Sequence[Sprite | None] = ()
    ) -> Picture:
        """The arm with its tip at a place of the lattice, solids with the mask values they get, and flat decals.

        Decals lie on the table: they hide nothing but it.
        """
        layer = self._layer(place)
        self._start(layer)
        present = [(sprite, label) for sprite, label in sprites if sprite is not None]
        flat = [decal for decal in decals if decal is not None]
        for decal in flat:
            on_table = decal.covered & (decal.inverse_depth > self._depth[decal.window])
            np.copyto(self._colors[decal.window], decal.colors, where=on_table[..., None])
        for sprite, label in present:
            nearer = sprite.covered & (sprite.inverse_depth > self._depth[sprite.window])
            np.copyto(self._depth[sprite.window], sprite.inverse_depth, where=nearer)
            np.copyto(self._colors[sprite.window], sprite.colors, where=nearer[..., None])
            np.copyto(self._labels[sprite.window], np.uint8(label), where=nearer)
        frame = layer.picture.copy()
        for sprite in [*flat, *(sprite for sprite, _ in present)]:
            rows, columns = (slice(side.start // SAMPLES, side.stop // SAMPLES) for side in sprite.window)
            frame[rows, columns] = mean_of_samples(self._colors[sprite.window])
        visible = np.zeros(len(sprites))
        for index, (shown, label) in enumerate(sprites):
            if shown is not None:
                visible[index] = (self._labels[shown.window] == label).sum() / shown.covered.sum()
        agent = (self._labels.reshape(-1)[layer.samples] == MASK_AGENT).mean() if len(layer.samples) else 0.0
        middle = SAMPLES // 2
        masks = self._labels[middle::SAMPLES, middle::SAMPLES].copy()
        return Picture(frame=frame, masks=masks, visible=visible, agent_visible=float(agent))

    def _start(self, layer: ArmLayer) -> None:
        np.copyto(self._colors, self._table_colors)
        np.copyto(self._depth, self._table_depth)
        self._labels.fill(MASK_BACKGROUND)
        self._colors.reshape(-1, 3)[layer.samples] = layer.colors
        self._depth.reshape(-1)[layer.samples] = layer.inverse_depth
        self._labels.reshape(-1)[layer.samples] = MASK_AGENT

    def _layer(self, place: Place) -> ArmLayer:
        if place not in self._layers:
            triangles, colors = self._arm(place)
            edges = triangles[:, 1:] - triangles[:, :1]
            normals = np.cross(edges[:, 0], edges[:, 1])
            normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
            facing = np.einsum("ni,ni->n", normals, triangles[:, 0] - self.camera.eye) < 0
            samples, depth, owners = rasterise(self.camera.project(triangles[facing]), self.camera.size)
            shown = depth > self._table_depth.reshape(-1)[samples]
            samples, depth = samples[shown], depth[shown]
            shades = self.light.shade(colors[facing], normals[facing])[owners[shown]]
            fine = self._table_colors.copy()
            fine.reshape(-1, 3)[samples] = shades
            self._layers[place] = ArmLayer(
                samples=samples, inverse_depth=depth, colors=shades, picture=mean_of_samples(fine)
            )
        return self._layers[place]


def mean_of_samples(fine: UInt8[np.ndarray, "hs ws 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Each pixel's mean over its samples, rounded."""
    total = np.zeros((fine.shape[0] // SAMPLES, fine.shape[1] // SAMPLES, 3), np.uint16)
    for row in range(SAMPLES):
        for column in range(SAMPLES):
            total += fine[row::SAMPLES, column::SAMPLES]
    return ((total + SAMPLES**2 // 2) // SAMPLES**2).astype(np.uint8)


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
