"""The Franka Emika Panda that holds the rod: its joints' geometry, its inverse kinematics, its surface.

The joints' origins are those of ``franka_panda/panda.urdf`` in pybullet_data; its collision hulls (3,000
triangles where the visual meshes have 102,000) are drawn, and a rod takes the place of the fingers.
The arm only carries the rod: what pushes is the rod, so the arm has no part in the physics.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from recorders.robot_push.solids import prism

ROD_RADIUS = 0.018  # [m]
ROD_LENGTH = 0.30  # [m], from the fingers' joint to the tip
FINGER_JOINT = 0.0584  # [m], from the hand's frame
TIP = FINGER_JOINT + ROD_LENGTH  # [m], from the hand's frame

HALF = np.pi / 2
_ORIGINS: tuple[tuple[tuple[float, float, float], float], ...] = (
    ((0.0, 0.0, 0.333), 0.0),  # each joint's place in its parent's frame [m] and turn about its x [rad]
    ((0.0, 0.0, 0.0), -HALF),
    ((0.0, -0.316, 0.0), HALF),
    ((0.0825, 0.0, 0.0), HALF),
    ((-0.0825, 0.384, 0.0), -HALF),
    ((0.0, 0.0, 0.0), HALF),
    ((0.088, 0.0, 0.0), HALF),
)
_FLANGE, _HAND_TURN = 0.107, -np.pi / 4  # link 7 to the hand: [m] along z, [rad] about z
_HOME = np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785])  # [rad]
_HAND_DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # turned: hides the least
_ITERATIONS = 100
_WHITE, _DARK = (0.93, 0.94, 0.95), (0.22, 0.22, 0.25)


def _frame(place: tuple[float, float, float], about_x: float) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(about_x), np.sin(about_x)
    x, y, z = place
    return np.array([[1, 0, 0, x], [0, c, -s, y], [0, s, c, z], [0, 0, 0, 1]])


def _about_z(angle: float) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


_JOINT_FRAMES = tuple(_frame(place, about_x) for place, about_x in _ORIGINS)
_HAND_FRAME = _frame((0.0, 0.0, _FLANGE), 0.0) @ _about_z(_HAND_TURN)


def link_frames(joints: Float[np.ndarray, "7"]) -> Float[np.ndarray, "9 4 4"]:
    """Poses of links 0 ... 7 and of the hand in the world [m]."""
    frames = [np.eye(4)]
    for origin, angle in zip(_JOINT_FRAMES, joints, strict=True):
        frames.append(frames[-1] @ origin @ _about_z(float(angle)))
    frames.append(frames[-1] @ _HAND_FRAME)
    return np.stack(frames)


def tip_of(frames: Float[np.ndarray, "9 4 4"]) -> Float[np.ndarray, "3"]:
    """Where the rod ends [m]."""
    return frames[-1, :3, 3] + TIP * frames[-1, :3, 2]


def joints_for(tip: Float[np.ndarray, "3"]) -> Float[np.ndarray, "7"]:
    """Joint angles [rad] that hold the rod upright with its end at ``tip`` [m].

    Damped least squares (Nakamura and Hanafusa 1986), always from the same home pose, so that the arm's pose
    is a function of the tip alone.
    """
    joints = _HOME.copy()
    for _ in range(_ITERATIONS):
        frames = link_frames(joints)
        turn = frames[-1, :3, :3]
        miss = 0.5 * np.cross(turn.T, _HAND_DOWN.T).sum(axis=0)  # small-angle rotation still to make
        error = np.concatenate([tip - tip_of(frames), miss])
        if np.abs(error).max() < 1e-6:
            break
        axes, places = frames[1:8, :3, 2], frames[1:8, :3, 3]
        jacobian = np.concatenate([np.cross(axes, tip_of(frames) - places).T, axes.T])
        damped = jacobian @ jacobian.T + 1e-4 * np.eye(6)
        joints = joints + jacobian.T @ np.linalg.solve(damped, error)
    return joints


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The arm's triangles, each in the frame of its link.

    Attributes:
        corners: [m].
        links: Index into ``link_frames``.
        colors: RGB, 0-1.
    """

    corners: Float[np.ndarray, "n 3 3"]
    links: Int[np.ndarray, " n"]
    colors: Float[np.ndarray, "n 3"]

    def posed(self, frames: Float[np.ndarray, "9 4 4"]) -> Float[np.ndarray, "n 3 3"]:
        """The triangles in the world [m]."""
        turns, shifts = frames[self.links, :3, :3], frames[self.links, :3, 3]
        corners: Float[np.ndarray, "n 3 3"] = np.einsum("nij,nvj->nvi", turns, self.corners) + shifts[:, None]
        return corners


def read_triangles(path: Path) -> Float[np.ndarray, "n 3 3"]:
    """The faces of a Wavefront .obj file, cut into triangles."""
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in path.read_text().splitlines():
        kind, *fields = line.split() or [""]
        if kind == "v":
            vertices.append([float(field) for field in fields[:3]])
        elif kind == "f":
            face = [int(field.split("/")[0]) - 1 for field in fields]
            triangles += [(face[0], b, c) for b, c in pairwise(face[1:])]
    corners: Float[np.ndarray, "n 3 3"] = np.asarray(vertices)[np.asarray(triangles)]
    return corners


def _prism_triangles(sides: int, radius: float, bottom: float, top: float) -> Float[np.ndarray, "n 3 3"]:
    corners = prism(sides, radius, top - bottom).corners + np.array([0, 0, (bottom + top) / 2])
    low, high = corners[:sides], corners[sides:]
    after_low, after_high = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    middle = np.broadcast_to([0.0, 0.0, top], low.shape)
    end = np.broadcast_to([0.0, 0.0, bottom], low.shape)
    faces = [(low, after_low, high), (high, after_low, after_high), (high, after_high, middle)]
    return np.concatenate([np.stack(face, axis=1) for face in [*faces, (after_low, low, end)]])


@cache
def surface(meshes: Path) -> Surface:
    """The arm's surface out of the folder ``franka_panda/meshes`` of pybullet_data."""
    parts = [read_triangles(meshes / "collision" / f"link{index}.obj") for index in range(8)]
    parts.append(read_triangles(meshes / "collision" / "hand.obj"))
    rod = _prism_triangles(16, ROD_RADIUS, FINGER_JOINT, TIP)
    links = np.concatenate([np.full(len(part), link) for link, part in enumerate(parts)] + [np.full(len(rod), 8)])
    colors = np.broadcast_to(_WHITE, (len(links), 3)).copy()
    colors[-len(rod) :] = _DARK
    return Surface(corners=np.concatenate([*parts, rod]), links=links, colors=colors)
