"""The pushing itself, in pymunk: flat shapes on a table, seen from above, and a disc that pushes them.

Gravity points into the picture, so the table's friction is a pair of joints for each shape that hold it with a
force and a torque of at most friction x weight (Coulomb). 120 Hz; a step moves the disc at a constant speed for 21
substeps and then waits until all is at rest. Where the disc's way touches nothing, nothing is simulated. A shape
whose centre leaves the table has fallen, and is taken out.

Lengths are centimetres inside, metres outside: Chipmunk's tolerances are made for numbers of about one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pymunk
from jaxtyping import Bool, Float

from recorders.planar_push.shapes import Shape

RATE = 120  # [Hz]
MOVING = 21  # substeps in which the disc moves
CHECK = 2  # substeps between two looks at whether all is at rest
PATIENCE = 60  # substeps that a step waits for rest, at most
AT_REST, AT_REST_TURNING = 1e-3, 1e-2  # [m/s], [rad/s]
CLEARANCE = 1e-3  # [m]: the disc's way touches what is nearer than this
CM = 100.0  # in a metre
GRAVITY = 9.81 * CM  # [cm/s^2]
SIDES_FRICTION = 0.5  # of the shapes' sides; the disc's is the same, and Chipmunk multiplies them
SLOP = 0.02  # [cm] that shapes may overlap

Pose = tuple[float, float, float]  # x and y [m], turn [rad]


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A shape to put on the table.

    Attributes:
        mass: [kg].
        friction: On the table.
        position: [m].
        angle: [rad].
    """

    shape: Shape
    mass: float
    friction: float
    position: tuple[float, float]
    angle: float


class PlanarPhysics:
    """A pymunk world, made anew for each episode and each restored state once something is pushed in it.

    Args:
        size: The table's length along x and y, its middle at (0, 0) [m].
        disc: The pusher's radius [m].
    """

    def __init__(self, *, size: tuple[float, float], disc: float) -> None:
        self._limits = (size[0] / 2 * CM, size[1] / 2 * CM)
        self._radius = disc

    def build(self, pieces: Sequence[Piece], disc: tuple[float, float]) -> None:
        """A new world with the disc's centre at ``disc`` [m]."""
        self._pieces = list(pieces)
        self._walls = [
            [(x, y, offset) for (x, y), offset in zip(*(part.tolist() for part in piece.shape.walls), strict=True)]
            for piece in pieces
        ]
        self._lie([(*piece.position, piece.angle) for piece in pieces], disc)

    def restore(
        self,
        positions: Float[np.ndarray, "k 2"],
        angles: Float[np.ndarray, " k"],
        disc: tuple[float, float],
    ) -> None:
        """Be at rest with the shapes at these poses, NaN for the fallen ones, in a new world without contacts."""
        poses = zip(positions.tolist(), angles.tolist(), strict=True)
        self._lie([None if math.isnan(angle) else (x, y, angle) for (x, y), angle in poses], disc)

    def _lie(self, poses: list[Pose | None], disc: tuple[float, float]) -> None:
        """Be at rest at these poses, None for the fallen ones; most states are left before anything is pushed there."""
        self._space: pymunk.Space | None = None
        self._place, self.at_rest = disc, True
        self._take_poses(poses)
        self.fallen: Bool[np.ndarray, " k"] = np.isnan(self.angles)

    def _enter(self) -> pymunk.Space:
        """The pymunk world, made if there is none yet."""
        if self._space is None:
            self._space = pymunk.Space()
            self._space.iterations = 15
            self._space.collision_slop = SLOP
            self._bodies = [
                self._build_piece(self._space, piece, pose)
                for piece, pose in zip(self._pieces, self.poses, strict=True)
            ]
            self._disc = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
            rim = pymunk.Circle(self._disc, self._radius * CM)
            rim.friction = SIDES_FRICTION
            self._space.add(self._disc, rim)
            for index in np.flatnonzero(self.fallen):  # only now, as pymunk numbers the shapes by their order
                self._take_out(int(index))
            self._place_disc(self._place)
        return self._space

    def move(self, goal: tuple[float, float]) -> bool:
        """Move the disc's centre to ``goal`` [m] on a straight line, and wait until all is at rest.

        Returns:
            Whether anything may have moved.
        """
        simulated = not self.at_rest or self._touches(goal)
        if simulated:
            start = self._place
            self._enter()
            self._disc.velocity = (
                (goal[0] - start[0]) * CM * RATE / MOVING,
                (goal[1] - start[1]) * CM * RATE / MOVING,
            )
            self._simulate(MOVING)
            self._disc.velocity = (0.0, 0.0)
            self._rest()
            self._read_poses()
        self._place_disc(goal)
        return simulated

    def speeds(self) -> Float[np.ndarray, "k 2"]:
        """How fast each shape that has not fallen moves [m/s] and turns [rad/s]."""
        self._enter()
        standing = (body for body, gone in zip(self._bodies, self.fallen, strict=True) if not gone)
        return np.array([(body.velocity.length / CM, abs(body.angular_velocity)) for body in standing]).reshape(-1, 2)

    @staticmethod
    def _build_piece(space: pymunk.Space, piece: Piece, pose: Pose | None) -> pymunk.Body:
        radius = piece.shape.radius * CM
        corners = [(float(x), float(y)) for x, y in piece.shape.corners * CM]
        if corners:
            body = pymunk.Body(piece.mass, pymunk.moment_for_poly(piece.mass, corners))
            sides: pymunk.Shape = pymunk.Poly(body, corners)
        else:
            body = pymunk.Body(piece.mass, pymunk.moment_for_circle(piece.mass, 0, radius))
            sides = pymunk.Circle(body, radius)
        sides.friction = SIDES_FRICTION
        x, y, body.angle = (*piece.position, piece.angle) if pose is None else pose
        body.position = (x * CM, y * CM)
        holding = pymunk.PivotJoint(space.static_body, body, (0, 0), (0, 0))
        turning = pymunk.GearJoint(space.static_body, body, 0.0, 1.0)
        holding.max_bias = turning.max_bias = 0  # friction against motion, not a spring back to the start
        holding.max_force = piece.friction * piece.mass * GRAVITY
        turning.max_force = holding.max_force * radius * 0.6  # about the mean distance of a shape's points
        space.add(body, sides, holding, turning)
        return body

    def _simulate(self, substeps: int) -> None:
        step = self._enter().step
        for _ in range(substeps):
            step(1 / RATE)

    def _rest(self) -> None:
        """Wait until all that has not fallen is at rest, then stop it altogether."""
        for _ in range(PATIENCE // CHECK):
            self._simulate(CHECK)
            self._take_fallen()
            self.at_rest = self._is_at_rest()
            if self.at_rest:
                break
        if self.at_rest:
            for body, gone in zip(self._bodies, self.fallen, strict=True):
                if not gone:
                    body.velocity, body.angular_velocity = (0.0, 0.0), 0.0

    def _is_at_rest(self) -> bool:
        for body, gone in zip(self._bodies, self.fallen.tolist(), strict=True):
            if not gone:
                x, y = body.velocity
                if not (math.hypot(x, y) / CM < AT_REST and abs(body.angular_velocity) < AT_REST_TURNING):
                    return False
        return True

    def _take_fallen(self) -> None:
        x_limit, y_limit = self._limits
        for index, body in enumerate(self._bodies):
            x, y = body.position
            if (abs(x) > x_limit or abs(y) > y_limit) and not self.fallen[index]:
                self._take_out(index)

    def _take_out(self, index: int) -> None:
        body = self._bodies[index]
        self._enter().remove(body, *body.shapes, *body.constraints)
        self.fallen[index] = True

    def _read_poses(self) -> None:
        poses: list[Pose | None] = []
        for body, gone in zip(self._bodies, self.fallen.tolist(), strict=True):
            x, y = body.position
            poses.append(None if gone else (x / CM, y / CM, body.angle))
        self._take_poses(poses)

    def _take_poses(self, poses: list[Pose | None]) -> None:
        self.poses = poses
        numbers = np.array([(np.nan, np.nan, np.nan) if pose is None else pose for pose in poses]).reshape(-1, 3)
        self.positions, self.angles = numbers[:, :2], numbers[:, 2]

    def _place_disc(self, place: tuple[float, float]) -> None:
        if self._space is not None:
            self._disc.position = (place[0] * CM, place[1] * CM)
        self._place = place

    def _touches(self, goal: tuple[float, float]) -> bool:
        """Whether the disc could meet a shape on its straight way; errs on the side of yes."""
        reach = self._radius + CLEARANCE
        way = (self._place, goal)
        (left, right), (bottom, top) = (sorted(ends) for ends in zip(*way, strict=True))
        for pose, piece, walls in zip(self.poses, self._pieces, self._walls, strict=True):
            if pose is None:
                continue
            x, y, angle = pose  # how far from the way, which is along x or y:
            apart = math.hypot(x - min(max(x, left), right), y - min(max(y, bottom), top))
            if apart > reach + piece.shape.radius:
                continue
            cos, sin = math.cos(angle), math.sin(angle)
            ends = [((u - x) * cos + (v - y) * sin, (v - y) * cos - (u - x) * sin) for u, v in way]  # in its frame
            if not any(all(u * nx + v * ny > offset + reach for u, v in ends) for nx, ny, offset in walls):
                return True
        return False
