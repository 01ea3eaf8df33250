"""The motion of PushT in pymunk: a disc that a PD controller pulls to a target, and a T that it pushes.

As published (``pusht_env.py`` in the source that ``tee.py`` names): 100 Hz, ten substeps an action; the disc is
kinematic and accelerates by k_p x (target - position) - k_v x velocity; nothing that is not pushed goes on moving
(a damping of 0), which stands for the friction of a table; walls hold the T, not the disc. The T's two rectangles have
no friction at their sides, and its moment of inertia counts the bar twice.

With pymunk 7 this moves as ``gym-pusht`` with pymunk 6, to 1e-13 mm (tests/recorders/test_push_t.py).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import pymunk

from recorders.push_t.tee import BAR, PARTS, RADIUS, SIDE, Pose, clearance

DT: Final = 0.01  # of a substep [s]
SUBSTEPS: Final = 10
INERTIA: Final = 2 * pymunk.moment_for_poly(1.0, BAR.corners)  # of the T, whose mass is 1
STIFFNESS, DAMPING = 100.0, 20.0  # k_p [1/s^2] and k_v [1/s]: critically damped
DISC_RADIUS: Final = 15.0  # [mm]
WALL: Final = (5.0, SIDE - 6.0)  # where the walls' middle lines are, along x and y [mm]
WALL_RADIUS: Final = 2.0  # [mm]
WALLS: Final = tuple(
    ((WALL[a], WALL[b]), (WALL[c], WALL[d])) for a, b, c, d in ((0, 1, 0, 0), (0, 0, 1, 0), (1, 0, 1, 1), (0, 1, 1, 1))
)
"""The ends of the walls' middle lines."""
INSIDE: Final = (WALL[0] + WALL_RADIUS, WALL[1] - WALL_RADIUS)
"""Between the walls [mm]."""
REACH: Final = DISC_RADIUS + 0.1  # from the disc's centre; a T that is farther away is not touched [mm]

Point = tuple[float, float]


class Motion(NamedTuple):
    """Where everything is between two actions.

    Attributes:
        disc: [mm].
        velocity: Of the disc [mm/s].
        tee: Where the T is.
        resting: Whether the T is at rest, and nothing but the disc could change that.
    """

    disc: Point
    velocity: Point
    tee: Pose
    resting: bool


class Snapshot(NamedTuple):
    """A state between two actions, exactly.

    Attributes:
        motion: Where everything is.
        before: Where everything was when the disc last came near a T at rest.
        since: The targets since then, which lead from there to ``motion``.
    """

    motion: Motion
    before: Motion
    since: tuple[Point, ...]


class PushPhysics:
    """The motion, a function of what ``put`` was given and of the targets since, bit by bit.

    Pymunk remembers contacts for three substeps and undoes overlaps by a velocity of its own. Neither can be read or
    set, so a state is restored by repeating the actions since the disc came near the T, in a new pymunk world. (Taking
    shapes out and putting them back in does not do: pymunk numbers them on, and their order decides roundings.) Where
    the disc cannot reach a T at rest, pymunk is not asked, and nothing has to be repeated afterwards.
    """

    def put(self, disc: Point, tee: Pose) -> None:
        """Everything at rest, the disc and the T there."""
        motion = Motion(disc=disc, velocity=(0.0, 0.0), tee=tee, resting=tee.within(*INSIDE))
        self.restore(Snapshot(motion=motion, before=motion, since=()))

    def snapshot(self) -> Snapshot:
        """The present state."""
        return Snapshot(motion=self.motion, before=self._before, since=self._since)

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a state."""
        self.motion, self._before, self._since = snapshot
        self._in_pymunk = False

    def control(self, target: Point) -> None:
        """Let the controller pull the disc to a target [mm] for a tenth of a second."""
        if self.motion.resting and (free := self._free(target)) is not None:
            self.motion = self._before = self.motion._replace(disc=free[0], velocity=free[1])
            self._since, self._in_pymunk = (), False
            return
        if not self._in_pymunk:
            self._enter()
        self._simulate(target)
        self._since = (*self._since, target)
        (x, y), (across, down), tee = self._disc.position, self._disc.velocity, self._tee
        now = Pose(*tee.position, tee.angle)
        untouched = now == self.motion.tee and not any(tee.velocity) and not tee.angular_velocity
        resting = untouched and now.within(*INSIDE)
        self.motion = Motion(disc=(x, y), velocity=(across, down), tee=now, resting=resting)

    def _simulate(self, target: Point) -> None:
        disc, (goal_x, goal_y), step = self._disc, target, self._space.step
        for _ in range(SUBSTEPS):
            (x, y), (across, down) = disc.position, disc.velocity
            disc.velocity = (
                across + (STIFFNESS * (goal_x - x) - DAMPING * across) * DT,
                down + (STIFFNESS * (goal_y - y) - DAMPING * down) * DT,
            )
            step(DT)

    def _free(self, target: Point) -> tuple[Point, Point] | None:
        """Where a disc that meets nothing is in the end, and its velocity; None where it might meet the T."""
        (x, y), (across, down), tee = self.motion.disc, self.motion.velocity, self.motion.tee
        (goal_x, goal_y), (center_x, center_y) = target, tee.centre
        room = math.hypot(x - center_x, y - center_y) - RADIUS - REACH  # it can move so far without a closer look
        for _ in range(SUBSTEPS):
            across += (STIFFNESS * (goal_x - x) - DAMPING * across) * DT
            down += (STIFFNESS * (goal_y - y) - DAMPING * down) * DT
            x, y = x + across * DT, y + down * DT
            room -= math.hypot(across, down) * DT
            if room < 0:
                room = clearance(tee, x, y) - REACH
                if room < 0:
                    return None
        return (x, y), (across, down)

    def _enter(self) -> None:
        """Build a pymunk world in the present state."""
        motion, space = self._before, pymunk.Space()
        space.damping = 0.0
        self._disc = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self._disc.position, self._disc.velocity = motion.disc, motion.velocity
        self._tee = pymunk.Body(1.0, INERTIA)
        sides = [pymunk.Poly(self._tee, part.corners) for part in PARTS]
        self._tee.center_of_gravity = (sides[0].center_of_gravity + sides[1].center_of_gravity) / 2
        self._tee.angle = motion.tee.angle  # first: it turns about the centre of gravity
        self._tee.position = motion.tee.x, motion.tee.y
        walls = [pymunk.Segment(space.static_body, *ends, WALL_RADIUS) for ends in WALLS]
        space.add(*walls, self._disc, pymunk.Circle(self._disc, DISC_RADIUS), self._tee, *sides)
        self._space, self._in_pymunk = space, True
        for target in self._since:
            self._simulate(target)
