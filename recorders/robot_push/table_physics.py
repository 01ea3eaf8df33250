"""The pushing itself, in PyBullet: a table, solids that slide on it, and the rod.

Only the rod pushes, so the arm is left out: the rod hangs on two prismatic joints whose motors hold its velocity
whatever it pushes. 240 Hz; a step moves the rod at a constant speed for 42 substeps and then waits until all is at
rest. Where the rod's way touches nothing, nothing is simulated and nothing moves. An object whose centre sinks
below the table's top has fallen, and is taken out.

Measured over 1,200 steps of the recording policy, of which a third push something and half are simulated at all: an
object's speed at the end of a step 0.002 m/s (p50), 0.003 (p99), taken away then; overlap of rod and object 0.4 mm
(p99), 0.8 (most); of two objects 0.3 mm, 1.3; the tip's error 0.002 mm; none of 180 objects toppled. A step costs
1.3 ms.

Every episode is built into an emptied world: rebuilding takes 2 ms and makes an episode a function of its seed and
actions (30 of 30 equal on a used simulation). Resetting the poses in a used world does not (0 of 30).
"""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dmotion_bench.errors import PackageNotInstalled
from recorders.robot_push.panda import ROD_RADIUS
from recorders.robot_push.solids import Solid, rotation_matrix

RATE = 240  # [Hz]
MOVING = 42  # substeps in which the rod moves
CHECK = 6  # substeps between two looks at whether all is at rest
PATIENCE = 240  # substeps that a step waits for rest, at most
AT_REST, AT_REST_TURNING = 5e-3, 0.1  # [m/s], [rad/s]
MARGIN = 1e-3  # [m]: Bullet's, around every convex hull
CLEARANCE = 4e-3  # [m]: the rod's way touches what is nearer than this
ROD_BOTTOM = 0.015  # [m] above the table: low enough that it slides objects and does not topple them
ROD_FRICTION = 0.5
TABLE_FRICTION = 1.0  # Bullet multiplies the frictions of what touches
MOTOR_FORCE = 1e4  # [N]: the rod never yields


@dataclass(frozen=True, kw_only=True)
class Body:
    """A solid to put on the table.

    Attributes:
        mass: [kg].
        friction: Its own; the table's is 1.
        position: [m].
        yaw: [rad].
    """

    solid: Solid
    mass: float
    friction: float
    position: tuple[float, float]
    yaw: float


@contextlib.contextmanager
def _silenced_stderr() -> Iterator[None]:
    """Bullet's C code announces its build time on import, past Python's ``sys.stderr``."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def load_bullet(name: str = "pybullet") -> ModuleType:
    """A module of PyBullet, or the error that says how to get it."""
    loaded = sys.modules.get(name)
    if loaded is not None:
        return loaded
    try:
        with _silenced_stderr():
            return importlib.import_module(name)
    except ImportError as error:
        raise PackageNotInstalled("pybullet", "robot_push", "pip install 'dmbench[robot]'") from error


class TablePhysics:
    """A Bullet world of its own.

    Args:
        size: The table's length along x and y [m].
        center: The middle of its top, which is at z = 0 [m].
    """

    def __init__(self, *, size: tuple[float, float], center: tuple[float, float]) -> None:
        self._bullet: Any = load_bullet()
        self._client: int = self._bullet.connect(self._bullet.DIRECT)
        self._size, self._center = size, center
        self._bodies: list[int] = []

    def build(self, bodies: Sequence[Body], rod: tuple[float, float]) -> None:
        """Empty the world and build it anew, with the rod's axis at ``rod`` [m]."""
        self._build_all(bodies, rod)
        self._stop()

    def _build_all(self, bodies: Sequence[Body], rod: tuple[float, float]) -> None:
        p, client = self._bullet, self._client
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0, 0, -9.81, physicsClientId=client)
        p.setPhysicsEngineParameter(fixedTimeStep=1 / RATE, deterministicOverlappingPairs=1, physicsClientId=client)
        self._build_table()
        self._bodies = [self._build_body(body) for body in bodies]
        self._rod = self._build_rod()
        self._place_rod(rod)
        self.positions = np.array([[*body.position, body.solid.height / 2 + MARGIN] for body in bodies]).reshape(-1, 3)
        self.quaternions = np.array([_upright(body.yaw) for body in bodies]).reshape(-1, 4)
        self.fallen: Bool[np.ndarray, " k"] = np.zeros(len(bodies), bool)
        self._low, self._high = (np.full((len(bodies), 2), np.nan) for _ in range(2))
        self._measured = np.full((len(bodies), 7), np.nan)
        self._built, self._solids = list(bodies), [body.solid for body in bodies]

    def restore(
        self, positions: Float[np.ndarray, "k 3"], quaternions: Float[np.ndarray, "k 4"], rod: tuple[float, float]
    ) -> None:
        """Be at rest with the solids at these poses, NaN for the fallen ones.

        Bullet keeps some memory of contacts, so what follows may differ from the original in its last bits.
        """
        p, client = self._bullet, self._client
        gone = np.isnan(positions[:, 0])
        if (self.fallen & ~gone).any():
            self._build_all(self._built, rod)
        for index, body in enumerate(self._bodies):
            if gone[index] and not self.fallen[index]:
                p.removeBody(body, physicsClientId=client)
            elif not gone[index]:
                p.resetBasePositionAndOrientation(body, positions[index], quaternions[index], physicsClientId=client)
        self._place_rod(rod)
        self.positions, self.quaternions, self.fallen = positions.copy(), quaternions.copy(), gone
        self._stop()

    def move(self, goal: tuple[float, float]) -> None:
        """Move the rod's axis to ``goal`` [m] on a straight line, and wait until all is at rest."""
        start = self.rod
        if not self.at_rest or self._touches(start, goal):
            self._drive([(to - of) * RATE / MOVING for of, to in zip(start, goal, strict=True)])
            for _ in range(MOVING):
                self._bullet.stepSimulation(physicsClientId=self._client)
            self._drive([0.0, 0.0])
            self._rest()
        self._place_rod(goal)

    def speeds(self) -> Float[np.ndarray, "k 2"]:
        """How fast each object that has not fallen moves [m/s] and turns [rad/s]."""
        standing = (body for body, gone in zip(self._bodies, self.fallen, strict=True) if not gone)
        velocities = [self._bullet.getBaseVelocity(body, physicsClientId=self._client) for body in standing]
        speeds: Float[np.ndarray, "k 2"] = np.linalg.norm(np.array(velocities).reshape(-1, 2, 3), axis=-1)
        return speeds

    def close(self) -> None:
        """Free the world."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def _build_table(self) -> None:
        p, client = self._bullet, self._client
        half = [self._size[0] / 2, self._size[1] / 2, 0.05]
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
        table = p.createMultiBody(0, shape, -1, [*self._center, -0.05], physicsClientId=client)
        p.changeDynamics(table, -1, lateralFriction=TABLE_FRICTION, restitution=0, physicsClientId=client)

    def _build_body(self, body: Body) -> int:
        p, client = self._bullet, self._client
        shape = p.createCollisionShape(p.GEOM_MESH, vertices=body.solid.corners.tolist(), physicsClientId=client)
        place = [*body.position, body.solid.height / 2 + MARGIN]
        made: int = p.createMultiBody(
            body.mass,
            shape,
            -1,
            place,
            _upright(body.yaw).tolist(),
            useMaximalCoordinates=1,  # a rigid body, not a multibody of one link: a sixth faster
            physicsClientId=client,
        )
        p.changeDynamics(
            made,
            -1,
            lateralFriction=body.friction,
            spinningFriction=0,
            rollingFriction=0,
            linearDamping=0.1,
            angularDamping=0.1,
            restitution=0,
            activationState=p.ACTIVATION_STATE_ENABLE_SLEEPING,
            physicsClientId=client,
        )
        return made

    def _build_rod(self) -> int:
        p, client = self._bullet, self._client
        shape = p.createCollisionShape(p.GEOM_CYLINDER, radius=ROD_RADIUS, height=0.3, physicsClientId=client)
        rod: int = p.createMultiBody(
            baseMass=0,
            basePosition=[0, 0, ROD_BOTTOM + 0.15],
            linkMasses=[1, 1],
            linkCollisionShapeIndices=[-1, shape],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0, 0, 0]] * 2,
            linkOrientations=[[0, 0, 0, 1]] * 2,
            linkInertialFramePositions=[[0, 0, 0]] * 2,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2,
            linkParentIndices=[0, 1],
            linkJointTypes=[p.JOINT_PRISMATIC] * 2,
            linkJointAxis=[[1, 0, 0], [0, 1, 0]],
            physicsClientId=client,
        )
        p.changeDynamics(rod, 1, lateralFriction=ROD_FRICTION, restitution=0, physicsClientId=client)
        return rod

    def _place_rod(self, place: tuple[float, float]) -> None:
        for joint, value in enumerate(place):
            self._bullet.resetJointState(self._rod, joint, value, 0, physicsClientId=self._client)
        self.rod = place

    def _drive(self, velocity: Sequence[float]) -> None:
        p = self._bullet
        for joint, value in enumerate(velocity):
            p.setJointMotorControl2(
                self._rod,
                joint,
                p.VELOCITY_CONTROL,
                targetVelocity=value,
                force=MOTOR_FORCE,
                physicsClientId=self._client,
            )

    def _touches(self, start: tuple[float, float], goal: tuple[float, float]) -> bool:
        """Whether the rod could meet an object on its way; errs on the side of yes."""
        reach = ROD_RADIUS + CLEARANCE
        low, high = np.minimum(start, goal) - reach, np.maximum(start, goal) + reach
        boxes_meet = (self._low <= high).all(axis=-1) & (self._high >= low).all(axis=-1)
        way = np.array([start, goal])
        for index in np.flatnonzero(boxes_meet):
            turn = rotation_matrix(self.quaternions[index])
            walls = (self._solids[index].normals @ turn.T)[:, :2]
            corners = self._solids[index].corners @ turn.T + self.positions[index]
            # Apart if some wall's plane, stood upright, has the object on one side and the way on the other.
            gaps = (way @ walls.T).min(axis=0) - (corners[:, :2] @ walls.T).max(axis=0)
            if not (gaps > reach * np.linalg.norm(walls, axis=-1) + 1e-9).any():
                return True
        return False

    def _measure(self) -> None:
        """Find each object's least and greatest x and y [m]; NaN for a fallen one, which is near nothing."""
        poses = np.concatenate([self.positions, self.quaternions], axis=-1)
        for index in np.flatnonzero((poses != self._measured).any(axis=-1) & ~self.fallen):
            turn = rotation_matrix(self.quaternions[index])
            corners = (self._solids[index].corners @ turn.T + self.positions[index])[:, :2]
            self._low[index], self._high[index] = corners.min(axis=0), corners.max(axis=0)
        self._low[self.fallen] = self._high[self.fallen] = np.nan
        self._measured = poses

    def _rest(self) -> None:
        """Wait until all that has not fallen is at rest, then stop it altogether."""
        self.at_rest, calm = False, False
        for _ in range(PATIENCE // CHECK):
            for _ in range(CHECK):
                self._bullet.stepSimulation(physicsClientId=self._client)
            self._read_poses()
            was_calm, calm = calm, self._calm()
            if calm and was_calm:  # twice, since something that rocks stands still for a moment
                self._stop()
                return
        self._measure()

    def _calm(self) -> bool:
        """Whether all that has not fallen is as good as at rest; quicker than to ask for all ``speeds``."""
        for body, gone in zip(self._bodies, self.fallen.tolist(), strict=True):
            if not gone:
                (x, y, z), (a, b, c) = self._bullet.getBaseVelocity(body, physicsClientId=self._client)
                if not (
                    math.sqrt(x * x + y * y + z * z) < AT_REST and math.sqrt(a * a + b * b + c * c) < AT_REST_TURNING
                ):
                    return False
        return True

    def _stop(self) -> None:
        """Take what little speed is left, and let all sleep until something touches it."""
        p, client = self._bullet, self._client
        for body, gone in zip(self._bodies, self.fallen, strict=True):
            if not gone:
                p.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=client)
                p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_SLEEP, physicsClientId=client)
        self.at_rest = True
        self._measure()

    def _read_poses(self) -> None:
        p, client = self._bullet, self._client
        for index, body in enumerate(self._bodies):
            if self.fallen[index]:
                continue
            position, quaternion = p.getBasePositionAndOrientation(body, physicsClientId=client)
            if position[2] < 0:
                p.removeBody(body, physicsClientId=client)
                self.fallen[index] = True
                self.positions[index], self.quaternions[index] = np.nan, np.nan
            else:
                self.positions[index], self.quaternions[index] = position, quaternion


def _upright(yaw: float) -> Float[np.ndarray, "4"]:
    return np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
