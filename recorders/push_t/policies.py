"""The recording policies of PushT: ``push`` goes for the T, ``random`` wanders.

Both lead the disc from one place to the next by targets that keep ahead of it by the same length, so that it moves at
a steady speed, as a hand does that shows the task. The lengths, and so the speeds, are drawn anew for each way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol, cast

import numpy as np
from jaxtyping import Float

from dmotion_bench.environment import Environment
from recorders.push_t.physics import DISC_RADIUS, INSIDE, Point
from recorders.push_t.tee import OUTLINE, SIDE, Pose, clearance

SLOWEST, FASTEST = 20.0, 90.0  # how far ahead of the disc its target is [mm]; at a steady speed it moves half of it
ARRIVED: Final = 12.0  # from the end of a way [mm]
PATIENCE: Final = 14  # actions on one way, at most
STAND_OFF = (6.0, 25.0)  # between the disc's edge and the T before a push [mm]
DEPTH = (40.0, 160.0)  # from where a push begins to where it ends [mm]
ASTRAY: Final = math.pi / 5  # by which a push misses the normal of the side, at most [rad]
MARGIN: Final = 80.0  # of the square, into which no push leads the T's centre [mm]
CHOICES: Final = 3  # places to push from, of which the nearest is taken
TRIES: Final = 24  # places to push from that are drawn, at most
SLANT: Final = 0.3  # of a way's length that it leads towards a wall, where it presses
NEAR: Final = 8.0  # between the disc and the T, or the T and a wall, when they are about to touch [mm]
BACK, RETREAT = 60.0, 4  # how far the disc moves back from a T that it would press against a wall [mm], and how long


class Steered(Protocol):
    """What the policies need to know beyond ``Environment``."""

    @property
    def disc(self) -> Point:
        """Where the disc is [mm]."""

    @property
    def tee(self) -> Pose:
        """Where the T is."""

    def towards(self, target: Point) -> Float[np.ndarray, "2"]:
        """The action that pulls the disc to a place [mm], as nearly as one can."""


class Wandering:
    """Goes to one place after another, evenly distributed over the square; made anew for each episode."""

    def __init__(self) -> None:
        self._ways: list[Point] = []
        self._ahead = SLOWEST
        self._left = 0

    def __call__(self, env: Environment, generator: np.random.Generator) -> Float[np.ndarray, "2"]:
        """The next action; ``env`` must also be ``Steered``."""
        world = cast(Steered, env)
        if self._ways and (self._left <= 0 or math.dist(world.disc, self._ways[0]) < ARRIVED):
            self._ways.pop(0)
            self._left = PATIENCE
        if self._ways and _presses(world, self._ways[0]):
            self._ways, self._left = [_retreat(world)], RETREAT
        if not self._ways:
            self._ways = list(self._next(world, generator))
            self._left, self._ahead = PATIENCE, float(generator.uniform(SLOWEST, FASTEST))
        self._left -= 1
        (x, y), (goal_x, goal_y) = world.disc, self._ways[0]
        far = math.dist(world.disc, self._ways[0])
        ahead = FASTEST if len(self._ways) > 1 else self._ahead  # to where a push begins it hurries
        share = min(1.0, ahead / far) if far else 1.0
        return world.towards((x + share * (goal_x - x), y + share * (goal_y - y)))

    def _next(self, world: Steered, generator: np.random.Generator) -> Sequence[Point]:
        """The places to go to next."""
        x, y = generator.uniform(*INSIDE, 2).tolist()
        return [(x, y)]


class Pushing(Wandering):
    """Goes to a place beside the T, pushes, and so on, and keeps the T away from the walls."""

    def _next(self, world: Steered, generator: np.random.Generator) -> Sequence[Point]:
        found: list[tuple[Point, Point]] = []
        for _ in range(TRIES):
            begin, way = _push(world.tee, generator)
            room = _room(world.tee.centre, way)
            if room > DEPTH[0] and all(INSIDE[0] < place < INSIDE[1] for place in begin):
                depth = min(room, float(generator.uniform(*DEPTH)))
                found.append((begin, (begin[0] + depth * way[0], begin[1] + depth * way[1])))
            if len(found) == CHOICES:
                break
        if not found:
            return [_retreat(world)]
        return min(found, key=lambda places: math.dist(places[0], world.disc))


def _room(center: Point, way: Point) -> float:
    """How far the T's centre can move in a direction before it is too near to a wall [mm]."""
    room = math.inf
    for place, step in zip(center, way, strict=True):
        if step:
            room = min(room, max(0.0, ((SIDE - MARGIN if step > 0 else MARGIN) - place) / step))
    return room


def _presses(world: Steered, goal: Point) -> bool:
    """Whether the way to a place presses a T that is at a wall against it."""
    tee, disc = world.tee, world.disc
    if clearance(tee, *disc) > DISC_RADIUS + NEAR:
        return False
    corners = [tee.place(*corner) for corner in OUTLINE]
    for axis in (0, 1):
        along = [corner[axis] for corner in corners]
        step = (goal[axis] - disc[axis]) / (math.dist(goal, disc) or 1.0)
        if (step < -SLANT and min(along) < INSIDE[0] + NEAR) or (step > SLANT and max(along) > INSIDE[1] - NEAR):
            return True
    return False


def _retreat(world: Steered) -> Point:
    """A place on the way from the T to the square's middle, or from the middle on where the T is there."""
    (x, y), (tee_x, tee_y) = world.disc, world.tee.centre
    far = math.dist((tee_x, tee_y), (SIDE / 2, SIDE / 2)) or 1.0
    return x + BACK * (SIDE / 2 - tee_x) / far, y + BACK * (SIDE / 2 - tee_y) / far


def _push(tee: Pose, generator: np.random.Generator) -> tuple[Point, Point]:
    """Where a push begins, beside a place of the T's outline, and its direction: about along the normal there."""
    lengths = [math.dist(corner, OUTLINE[place - 1]) for place, corner in enumerate(OUTLINE)]
    along = float(generator.uniform(0, sum(lengths)))
    side = 0
    while along > lengths[side]:
        along -= lengths[side]
        side += 1
    (x, y), (to_x, to_y) = OUTLINE[side - 1], OUTLINE[side]
    share = along / lengths[side]
    touched = tee.place(x + share * (to_x - x), y + share * (to_y - y))
    outward = math.atan2(-(to_x - x), to_y - y) + tee.angle + generator.uniform(-ASTRAY, ASTRAY)
    off = DISC_RADIUS + generator.uniform(*STAND_OFF)
    cos, sin = math.cos(outward), math.sin(outward)
    return (touched[0] + off * cos, touched[1] + off * sin), (-cos, -sin)
