"""The T of PushT: two rectangles of a grid of 30 mm, where it is, and how much of another T it covers.

Chi et al. 2023, "Diffusion Policy", RSS, have it from Florence et al. 2021, "Implicit Behavioral Cloning", CoRL. The
lengths are those of the published environment, whose square of 512 "pixels" has sides of 512 mm here:
https://github.com/real-stanford/diffusion_policy/blob/5ba07ac/diffusion_policy/env/pusht/pusht_env.py (``add_tee``).

A pose is the published one: where the middle of the bar's outer edge is, and by how much the T is turned, clockwise in
the picture, whose y goes down. At the angle 0 the stem points down.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from recorders.planar_push.shapes import Shape

SIDE: Final = 512.0  # of the square [mm]
UNIT: Final = 30.0  # the T's bar and stem are so wide [mm]
MM: Final = 1e-3  # [m]


class Rectangle(NamedTuple):
    """Bounds along x and y in the T's own frame [mm]."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def area(self) -> float:
        """[mm^2]."""
        return (self.right - self.left) * (self.bottom - self.top)

    @property
    def middle(self) -> tuple[float, float]:
        """[mm]."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """One after the other [mm]."""
        return (self.left, self.top), (self.right, self.top), (self.right, self.bottom), (self.left, self.bottom)


class Pose(NamedTuple):
    """Where the T is.

    Attributes:
        x, y: Of the middle of the bar's outer edge [mm].
        angle: [rad], from x towards y.
    """

    x: float
    y: float
    angle: float

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of the T's own frame is [mm]."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return self.x + x * cos - y * sin, self.y + x * sin + y * cos

    def local(self, x: float, y: float) -> tuple[float, float]:
        """A place in the T's own frame [mm]."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return (x - self.x) * cos + (y - self.y) * sin, (y - self.y) * cos - (x - self.x) * sin

    @property
    def centre(self) -> tuple[float, float]:
        """The centre of the T's area [mm]."""
        return self.place(*CENTRE)

    def within(self, low: float, high: float) -> bool:
        """Whether all of the T is between these bounds along x and y [mm]."""
        return all(low < place < high for corner in OUTLINE for place in self.place(*corner))

    @classmethod
    def of_centre(cls, x: float, y: float, angle: float) -> Pose:
        """The pose of a T whose area has its centre there [mm]."""
        right, down = cls(0.0, 0.0, angle).place(*CENTRE)
        return cls(x - right, y - down, angle)


BAR: Final = Rectangle(-2 * UNIT, 2 * UNIT, 0.0, UNIT)
STEM: Final = Rectangle(-UNIT / 2, UNIT / 2, UNIT, 4 * UNIT)
PARTS: Final = (BAR, STEM)
AREA: Final = BAR.area + STEM.area
CENTRE: Final = (0.0, (BAR.area * BAR.middle[1] + STEM.area * STEM.middle[1]) / AREA)
RADIUS: Final = max(math.dist(corner, CENTRE) for part in PARTS for corner in part.corners)
"""Of the smallest circle around the centre that holds the T [mm]."""

GOAL: Final = Pose(SIDE / 2, SIDE / 2, math.pi / 4)
"""The published goal."""

OUTLINE: Final = (*BAR.corners[:3], STEM.corners[1], STEM.corners[2], STEM.corners[3], STEM.corners[0], BAR.corners[3])
"""The T's eight corners, one after the other [mm]."""


def coverage(pose: Pose, goal: Pose) -> float:
    """The share of a T at the goal that a T at the pose covers, 0 to 1.

    Each rectangle of the one is clipped by each of the other (Sutherland and Hodgman 1974); none overlaps its sibling.
    """
    if math.dist(pose.centre, goal.centre) >= 2 * RADIUS:
        return 0.0
    common = 0.0
    for part in PARTS:
        corners = [goal.local(*pose.place(*corner)) for corner in part.corners]
        common += sum(_clipped_area(corners, other) for other in PARTS)
    return min(1.0, common / AREA)


def _clipped_area(corners: list[tuple[float, float]], bounds: Rectangle) -> float:
    """The area of a convex polygon within bounds."""
    sides = ((0, bounds.left, 1.0), (0, bounds.right, -1.0), (1, bounds.top, 1.0), (1, bounds.bottom, -1.0))
    for axis, bound, sign in sides:
        kept: list[tuple[float, float]] = []
        for place, here in enumerate(corners):
            before = corners[place - 1]
            depth, depth_before = sign * (here[axis] - bound), sign * (before[axis] - bound)
            if (depth >= 0) != (depth_before >= 0):
                share = depth_before / (depth_before - depth)
                kept.append((before[0] + share * (here[0] - before[0]), before[1] + share * (here[1] - before[1])))
            if depth >= 0:
                kept.append(here)
        corners = kept
    return 0.5 * abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(corners, corners[1:] + corners[:1], strict=True)))


def clearance(pose: Pose, x: float, y: float) -> float:
    """How far a place is from the T [mm]; negative inside of one of its rectangles."""
    u, v = pose.local(x, y)
    apart = []
    for left, right, top, bottom in PARTS:
        across, along = max(left - u, u - right), max(top - v, v - bottom)
        apart.append(math.hypot(max(across, 0.0), max(along, 0.0)) + min(max(across, along), 0.0))
    return min(apart)


def part_shapes() -> tuple[tuple[Shape, tuple[float, float]], ...]:
    """The rectangles as shapes to draw, each around its middle, and where the middle is in the T's own frame [m]."""
    found = []
    for part in PARTS:
        middle = np.array(part.middle)
        corners = (np.array(part.corners) - middle) * MM
        radius = float(np.linalg.norm(corners, axis=1).max())
        found.append((Shape(corners=corners, radius=radius), (float(middle[0] * MM), float(middle[1] * MM))))
    return tuple(found)
