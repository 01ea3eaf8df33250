"""Draws PushT in 128x128 pixels of 4 mm, antialiased, in the published colours: those that pygame knows by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

from recorders.planar_push.drawing import Stamp, View, covered, painted, signed_distance, stamp, window
from recorders.planar_push.shapes import circle, rectangle
from recorders.push_t.physics import DISC_RADIUS, WALL, WALL_RADIUS
from recorders.push_t.tee import GOAL, MM, RADIUS, SIDE, Pose, part_shapes

SIZE: Final = 128
DISC_COLOR: Final = (65, 105, 225)  # royal blue
TEE_COLOR: Final = (119, 136, 153)  # light slate grey
ZONE_COLOR: Final = (144, 238, 144)  # light green
WALL_COLOR: Final = (211, 211, 211)  # light grey
FLOOR_COLOR: Final = (255, 255, 255)

DISC: Final = circle(DISC_RADIUS * MM)
SHAPES: Final = part_shapes()

Color = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Screen(View):
    """The square as the published environment shows it: x to the right, y down, (0, 0) at the upper left corner."""

    size: int = SIZE
    scale: float = SIZE / (SIDE * MM)

    @cached_property
    def matrix(self) -> Float[np.ndarray, "2 2"]:
        """From the world's x, y [m] to the picture's, right and down [px]."""
        return self.scale * np.eye(2)

    def project(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """World [m] to picture [px]."""
        pixels: Float[np.ndarray, "*n 2"] = points * self.scale - 0.5
        return pixels


SCREEN: Final = Screen()


def disc_stamp(x: float, y: float) -> Stamp | None:
    """The disc at a place [mm]; None where the picture does not show it."""
    return stamp(SCREEN, DISC, np.array([x, y]) * MM, 0.0, DISC_COLOR)


def tee_stamp(pose: Pose, color: Color = TEE_COLOR) -> Stamp | None:
    """The T at a pose; None where the picture does not show it.

    Its rectangles overlap nowhere, so that they cover of a pixel what each of them covers.
    """
    area = window(SCREEN, np.array(pose.centre) * MM, RADIUS * MM)
    if area is None:
        return None
    total, inside = None, None
    for shape, middle in SHAPES:
        place = np.array(pose.place(middle[0] / MM, middle[1] / MM)) * MM
        distance = signed_distance(SCREEN, shape, place, pose.angle, area)
        within = distance <= 0
        inside = within if inside is None else inside | within
        total = covered(distance) if total is None else np.minimum(total + covered(distance), np.uint16(256))
    assert total is not None
    assert inside is not None
    return painted(area, total, inside, color, SCREEN.size)


@lru_cache(maxsize=1)
def background() -> UInt8[np.ndarray, "h w 3"]:
    """What never moves: the floor, the walls, and where the published goal is."""
    frame = np.empty((SIZE, SIZE, 3), np.uint8)
    frame[:] = FLOOR_COLOR
    zone = tee_stamp(GOAL, ZONE_COLOR)
    assert zone is not None
    zone.lay(frame)
    low, high = WALL
    length, middle = high - low + 2 * WALL_RADIUS, (low + high) / 2
    for turn, (x, y) in ((0.0, (middle, low)), (0.0, (middle, high)), (0.5, (low, middle)), (0.5, (high, middle))):
        place = np.array([x, y]) * MM
        wall = stamp(SCREEN, rectangle(length * MM, 2 * WALL_RADIUS * MM), place, turn * math.pi, WALL_COLOR)
        assert wall is not None
        wall.lay(frame)
    return frame
