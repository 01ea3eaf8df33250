"""Draws the scene: arm, table, solids, with 3x3 samples a pixel, in numpy.

Why not Bullet's TinyRenderer: it takes 3-4 ms a picture, has no antialiasing, and tells neither how much of an
object is hidden nor what its silhouette's centre is. The arm's pose is a function of the tip, and the tip stands on a
lattice, so that every pose of the arm is rasterised once and kept (``arm_layer.py``); a solid that has not moved keeps
its sprite (``sprite.py``), and what stands in its window, too, where neither its neighbours nor the arm changed that.

Light is a white lamp far away (ambient plus Lambert), without shadows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from dmotion_bench.specs import MASK_AGENT, MASK_BACKGROUND
from recorders.robot_push.arm_layer import ArmLayer, ArmPose, arm_layer
from recorders.robot_push.camera import Camera
from recorders.robot_push.light import Light
from recorders.robot_push.samples import (
    NOTHING,
    SAMPLES,
    labels_of,
    mean_of_samples,
    middle_labels,
    overlap,
    painted,
    within,
)
from recorders.robot_push.solids import Solid
from recorders.robot_push.sprite import Sprite, sprite_of
from recorders.table_lattice import KEPT_PLACES, Place

BACKGROUND = (236, 239, 243)  # RGB


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


@dataclass(frozen=True, kw_only=True)
class _Patch:
    """What stands in a sprite's window where the arm does not reach into it.

    Attributes:
        near: The sprites whose windows meet its own, and itself, in the order in which they are drawn.
        frame, masks: The finished picture there.
        visible: The share of its samples that nothing hides.
    """

    near: Sequence[Sprite]
    frame: UInt8[np.ndarray, "h w 3"]
    masks: UInt8[np.ndarray, "h w"]
    visible: float


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
        nothing = painted(np.array([BACKGROUND], np.uint8), np.array([MASK_BACKGROUND], np.uint8))
        self._table_paints = np.full((fine, fine), nothing[0])
        self._table_depth = np.full((fine, fine), NOTHING)
        solid, place, color = table
        sprite = self.sprite(solid, place, np.array([0.0, 0.0, 0.0, 1.0]), color, MASK_BACKGROUND)
        if sprite is not None:
            np.copyto(self._table_paints[sprite.fine], sprite.paints, where=sprite.covered)
            np.copyto(self._table_depth[sprite.fine], sprite.inverse_depth, where=sprite.covered)
        self._paints, self._depth = self._table_paints.copy(), self._table_depth.copy()
        self._shown: list[Sprite] = []
        self._near: list[list[int]] = []
        self._patches: dict[int, _Patch] = {}

    def sprite(
        self,
        solid: Solid,
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        color: tuple[float, float, float],
        label: int,
    ) -> Sprite | None:
        """A solid at a pose [m], of a colour (RGB, 0-1) and a mask value; None where the camera does not see it."""
        return sprite_of(solid, (position, quaternion), (color, label), self.camera, self.light)

    def picture(self, place: Place, sprites: Sequence[Sprite | None], decals: Sequence[Sprite | None] = ()) -> Picture:
        """The arm with its tip at a place of the lattice, solids, and flat decals, which hide nothing but the table."""
        layer = self._layer(place)
        self._arrange([one for one in (*decals, *sprites) if one is not None])
        reached = [bool(layer.touched[one.window].any()) for one in self._shown]
        anew = [index for index, one in enumerate(self._shown) if reached[index] or id(one) not in self._patches]
        hidden = self._draw(anew, layer, reached)

        frame, masks = layer.frame.copy(), layer.masks.copy()
        visible: dict[int, float] = {}
        for index, one in enumerate(self._shown):
            patch = self._patch_of(index) if index in anew else self._patches[id(one)]
            frame[one.window], masks[one.window] = patch.frame, patch.masks
            visible[id(one)] = patch.visible
            if not reached[index]:
                self._patches[id(one)] = patch
        return Picture(
            frame=frame,
            masks=masks,
            visible=np.array([0.0 if one is None else visible[id(one)] for one in sprites]),
            agent_visible=(layer.moving - hidden) / layer.moving if layer.moving else 0.0,
        )

    def _arrange(self, shown: list[Sprite]) -> None:
        """Take note of what is to be drawn, in this order, and drop the patches that something else lies in now."""
        if _same(shown, self._shown):
            return
        self._shown = shown
        self._near = [[i for i, other in enumerate(shown) if _meet(one.window, other.window)] for one in shown]
        known, self._patches = self._patches, {}
        for one, near in zip(shown, self._near, strict=True):
            patch = known.get(id(one))
            if patch is not None and _same(patch.near, [shown[index] for index in near]):
                self._patches[id(one)] = patch

    def _draw(self, anew: Sequence[int], layer: ArmLayer, reached: Sequence[bool]) -> int:
        """Draw the samples of some sprites' windows; how many samples of the arm lie behind solids.

        Their neighbours are drawn whole: elsewhere the samples may hold anything.
        """
        for window in (self._shown[index].fine for index in anew):
            self._paints[window] = self._table_paints[window]
            self._depth[window] = self._table_depth[window]
            both = overlap(window, layer.window)
            self._paints[both] = layer.paints[within(both, layer.window)]
            self._depth[both] = layer.inverse_depth[within(both, layer.window)]
        hidden = 0
        for index in sorted({near for other in anew for near in self._near[other]}):
            one = self._shown[index]
            nearer = one.inverse_depth > self._depth[one.fine]
            nearer &= one.covered
            if reached[index]:
                hidden += int(np.count_nonzero((labels_of(self._paints[one.fine]) == MASK_AGENT) & nearer))
            np.copyto(self._paints[one.fine], one.paints, where=nearer)
            if one.label != MASK_BACKGROUND:
                np.copyto(self._depth[one.fine], one.inverse_depth, where=nearer)
        return hidden

    def _patch_of(self, index: int) -> _Patch:
        """What has been drawn in a sprite's window."""
        one = self._shown[index]
        paints = self._paints[one.fine]
        return _Patch(
            near=[self._shown[near] for near in self._near[index]],
            frame=mean_of_samples(paints),
            masks=middle_labels(paints),
            visible=np.count_nonzero(labels_of(paints) == one.label) / one.count,
        )

    def _layer(self, place: Place) -> ArmLayer:
        if place not in self._layers:
            if len(self._layers) >= KEPT_PLACES:  # with continuous actions there is no end of places
                self._layers.clear()
            table = self._table_paints, self._table_depth
            self._layers[place] = arm_layer(self._arm(place), self.camera, self.light, table)
        return self._layers[place]


def _same(some: Sequence[Sprite], others: Sequence[Sprite]) -> bool:
    """Whether these are the same sprites in the same order."""
    return len(some) == len(others) and all(one is other for one, other in zip(some, others, strict=True))


def _meet(one: tuple[slice, slice], other: tuple[slice, slice]) -> bool:
    """Whether two windows have a pixel in common."""
    return all(mine.start < theirs.stop and theirs.start < mine.stop for mine, theirs in zip(one, other, strict=True))
