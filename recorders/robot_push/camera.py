"""A pinhole camera that looks at the table, and what it needs to draw convex solids exactly.

Depths are taken along the optical axis, so the inverse depth of a plane is a linear function of the picture's
coordinates: three numbers a plane are all that a picture of a convex solid needs (``inverse_depth_planes``).
Picture coordinates are pixels with the centre of pixel (0, 0) at (0, 0), x to the right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from dmotion_bench.errors import InvalidSetting


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Where the camera stands and how much it sees.

    Attributes:
        target: The point in the middle of the picture [m].
        distance: From the target to the eye [m].
        yaw: 90 looks along -x, toward the robot's base; more turns the camera around the target [deg].
        pitch: Negative looks down [deg].
        field_of_view: From the top to the bottom of the picture [deg].
        size: Height and width of the square picture [px].
    """

    target: tuple[float, float, float] = (0.485, 0.0, 0.03)
    distance: float = 1.5
    yaw: float = 90.0
    pitch: float = -52.0
    field_of_view: float = 26.0
    size: int = 128

    def __post_init__(self) -> None:
        for name, low, high in (("pitch", -90.0, -5.0), ("distance", 0.7, 20.0), ("field_of_view", 1.0, 120.0)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InvalidSetting(f"{name} is {value:g}; it can be {low:g} to {high:g}.")

    @cached_property
    def eye(self) -> Float[np.ndarray, "3"]:
        """Where the camera stands [m]."""
        eye: Float[np.ndarray, "3"] = np.asarray(self.target) - self.distance * self.axes[2]
        return eye

    @cached_property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Unit vectors in the world: right, up, forward."""
        yaw, pitch = np.deg2rad(self.yaw), np.deg2rad(self.pitch)
        forward = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        return np.stack([right, np.cross(right, forward), forward])

    @cached_property
    def focal_length(self) -> float:
        """[px]."""
        return float(self.size / 2 / np.tan(np.deg2rad(self.field_of_view) / 2))

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Picture coordinates x, y [px] and inverse depth [1/m] of points in the world [m]."""
        seen = (points - self.eye) @ self.axes.T
        inverse_depth = 1.0 / seen[..., 2]
        middle = (self.size - 1) / 2
        projected: Float[np.ndarray, "*n 3"] = np.empty_like(seen)  # np.stack takes as long as all the rest
        projected[..., 0] = middle + self.focal_length * seen[..., 0] * inverse_depth
        projected[..., 1] = middle - self.focal_length * seen[..., 1] * inverse_depth
        projected[..., 2] = inverse_depth
        return projected

    def inverse_depth_planes(
        self, normals: Float[np.ndarray, "f 3"], offsets: Float[np.ndarray, " f"]
    ) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, " f"]]:
        """Each plane ``normal @ point = offset`` as inverse depth ``c[0] * x + c[1] * y + c[2]`` in the picture.

        Returns:
            The coefficients, and the eye's distance behind each plane [m]: negative where the camera sees the
            plane's outer side.
        """
        behind = offsets - normals @ self.eye
        # A plane through the eye is seen edge-on, as a line: push it off by less than anything visible.
        behind = np.where(np.abs(behind) < 1e-9, 1e-9, behind)
        right, up, forward = (normals @ self.axes.T / behind[:, None]).T
        along_x, along_y = right / self.focal_length, -up / self.focal_length
        middle = (self.size - 1) / 2
        return np.stack([along_x, along_y, forward - middle * (along_x + along_y)], axis=-1), behind
