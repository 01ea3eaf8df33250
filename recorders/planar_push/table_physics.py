"""The pushing itself, in pymunk: flat shapes on a table, seen from above, and a disc that pushes them.

Gravity points into the picture, so the table's friction is a pair of joints for each shape that hold it with a
force and a torque of at most friction x weight (Coulomb). 120 Hz; a step moves the disc at a constant speed for 21
substeps and then waits until all is at rest. Where the disc's way touches nothing, nothing is simulated. A shape
whose centre leaves the table has fallen, and is taken out.

Lengths are centimetres inside, metres outside: Chipmunk's tolerances are made for numbers of about one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    """A pymunk world, built anew for each episode.

    Args:
        size: The table's length along x and y, its middle at (0, 0) [m].
        disc: The pusher's radius [m].
    """

    def __init__(self, *, size: tuple[float, float], disc: float) -> None:
        self._half, self._radius = np.asarray(size) / 2, disc

    def build(self, pieces: Sequence[Piece], disc: tuple[float, float]) -> None:
        """A new world with the disc's centre at ``disc`` [m]."""
        self._space = pymunk.Space()
        self._space.iterations = 15
        self._space.collision_slop = SLOP
        self._pieces = list(pieces)
        self._bodies = [self._build_piece(piece) for piece in pieces]
        self._disc = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        rim = pymunk.Circle(self._disc, self._radius * CM)
        rim.friction = SIDES_FRICTION
        self._space.add(self._disc, rim)
        self.fallen: Bool[np.ndarray, " k"] = np.zeros(len(pieces), bool)
        self.positions = np.array([piece.position for piece in pieces]).reshape(-1, 2)
        self.angles = np.array([piece.angle for piece in pieces])
        self._walls = [piece.shape.walls for piece in pieces]
        self._circles = np.array([piece.shape.radius for piece in pieces])
        self.at_rest = True
        self._place_disc(disc)

    def restore(
        self,
        positions: Float[np.ndarray, "k 2"],
        angles: Float[np.ndarray, " k"],
        disc: tuple[float, float],
    ) -> None:
        """Be at rest with the shapes at these poses, NaN for the fallen ones, in a new world without contacts."""
        gone = np.isnan(angles)
        pieces = [
            piece if fallen else replace(piece, position=(x, y), angle=angle)
            for piece, (x, y), angle, fallen in zip(
                self._pieces, positions.tolist(), angles.tolist(), gone, strict=True
            )
        ]
        self.build(pieces, disc)
        for index in np.flatnonzero(gone):
            self._take_out(int(index))
        self.positions[gone], self.angles[gone] = np.nan, np.nan

    def move(self, goal: tuple[float, float]) -> None:
        """Move the disc's centre to ``goal`` [m] on a straight line, and wait until all is at rest."""
        if not self.at_rest or self._touches(goal):
            start = self._place
            self._disc.velocity = (
                (goal[0] - start[0]) * CM * RATE / MOVING,
                (goal[1] - start[1]) * CM * RATE / MOVING,
            )
            self._simulate(MOVING)
            self._disc.velocity = (0.0, 0.0)
            self._rest()
            self._read_poses()
        self._place_disc(goal)

    def speeds(self) -> Float[np.ndarray, "k 2"]:
        """How fast each shape that has not fallen moves [m/s] and turns [rad/s]."""
        standing = (body for body, gone in zip(self._bodies, self.fallen, strict=True) if not gone)
        return np.array([(body.velocity.length / CM, abs(body.angular_velocity)) for body in standing]).reshape(-1, 2)

    def _build_piece(self, piece: Piece) -> pymunk.Body:
        space, radius = self._space, piece.shape.radius * CM
        corners = [(float(x), float(y)) for x, y in piece.shape.corners * CM]
        if corners:
            body = pymunk.Body(piece.mass, pymunk.moment_for_poly(piece.mass, corners))
            sides: pymunk.Shape = pymunk.Poly(body, corners)
        else:
            body = pymunk.Body(piece.mass, pymunk.moment_for_circle(piece.mass, 0, radius))
            sides = pymunk.Circle(body, radius)
        sides.friction = SIDES_FRICTION
        body.position = (piece.position[0] * CM, piece.position[1] * CM)
        body.angle = piece.angle
        holding = pymunk.PivotJoint(space.static_body, body, (0, 0), (0, 0))
        turning = pymunk.GearJoint(space.static_body, body, 0.0, 1.0)
        holding.max_bias = turning.max_bias = 0  # friction against motion, not a spring back to the start
        holding.max_force = piece.friction * piece.mass * GRAVITY
        turning.max_force = holding.max_force * radius * 0.6  # about the mean distance of a shape's points
        space.add(body, sides, holding, turning)
        return body

    def _simulate(self, substeps: int) -> None:
        for _ in range(substeps):
            self._space.step(1 / RATE)

    def _rest(self) -> None:
        """Wait until all that has not fallen is at rest, then stop it altogether."""
        for _ in range(PATIENCE // CHECK):
            self._simulate(CHECK)
            self._take_fallen()
            self.at_rest = bool((self.speeds() < [AT_REST, AT_REST_TURNING]).all())
            if self.at_rest:
                break
        if self.at_rest:
            for body, gone in zip(self._bodies, self.fallen, strict=True):
                if not gone:
                    body.velocity, body.angular_velocity = (0.0, 0.0), 0.0

    def _take_fallen(self) -> None:
        for index, body in enumerate(self._bodies):
            x, y = body.position
            if not self.fallen[index] and (abs(x) > self._half[0] * CM or abs(y) > self._half[1] * CM):
                self._take_out(index)

    def _take_out(self, index: int) -> None:
        body = self._bodies[index]
        self._space.remove(body, *body.shapes, *body.constraints)
        self.fallen[index] = True

    def _read_poses(self) -> None:
        for index, body in enumerate(self._bodies):
            gone = self.fallen[index]
            x, y = body.position
            self.positions[index] = (np.nan, np.nan) if gone else (x / CM, y / CM)
            self.angles[index] = np.nan if gone else body.angle

    def _place_disc(self, place: tuple[float, float]) -> None:
        self._disc.position = (place[0] * CM, place[1] * CM)
        self._place = place

    def _touches(self, goal: tuple[float, float]) -> bool:
        """Whether the disc could meet a shape on its straight way; errs on the side of yes."""
        reach = self._radius + CLEARANCE
        way = np.array([self._place, goal])
        low, high = way.min(axis=0), way.max(axis=0)
        apart = self.positions - np.clip(self.positions, low, high)  # from the way, which is along x or y
        for index in np.flatnonzero((apart**2).sum(axis=-1) <= (reach + self._circles) ** 2):
            normals, offsets = self._walls[index]
            cos, sin = np.cos(self.angles[index]), np.sin(self.angles[index])
            ends = (way - self.positions[index]) @ np.array([[cos, -sin], [sin, cos]])  # in the shape's frame
            if not len(offsets) or not ((ends @ normals.T).min(axis=0) > offsets + reach).any():
                return True
        return False
