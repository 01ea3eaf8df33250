"""The viewpoint of Rerun's 3D view that matches the camera's image.

Nothing is known of the camera but where it sees the things. A linear fit of their pixels to their places says which
way in the world is down in the picture; the eye stands on that side, above the things. A world whose y axis runs down
the picture, as Grid World's, is seen mirrored from above; the eye then stands below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

LOWEST = 1e-6
"""Spread of the things [m] below which no direction can be told."""


@dataclass(frozen=True)
class Eye:
    """A viewpoint in the world [m]; its ``up`` direction is z or -z."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]


def eye_of_camera(position: Float[np.ndarray, "n 3"], pixel: Float[np.ndarray, "n 2"]) -> Eye | None:
    """An eye that sees things roughly as the camera does.

    Args:
        position: Of things over an episode [m]; NaN where there is none.
        pixel: Of the same things.

    Returns:
        None where too few places are known.
    """
    known = np.isfinite(position).all(1) & np.isfinite(pixel).all(1)
    places, seen = position[known], pixel[known]
    if len(places) < 3:
        return None
    centre = (places.min(0) + places.max(0)) / 2
    size = float(np.ptp(places[:, :2], axis=0).max())
    ground = places[:, :2] - places[:, :2].mean(0)
    if size < LOWEST or np.linalg.matrix_rank(ground, tol=LOWEST) < 2:
        return None
    slope, *_ = np.linalg.lstsq(ground, seen - seen.mean(0), rcond=None)  # pixels a metre, x y -> right down
    down = slope[:, 1] / max(float(np.linalg.norm(slope[:, 1])), LOWEST)
    above = 1.0 if np.linalg.det(slope) < 0 else -1.0  # right and down turn the other way than x and y, seen from above
    eye = centre + size * np.array([*down, 1.2 * above])
    return Eye(position=_triple(eye), target=_triple(centre), up=(0.0, 0.0, above))


def _triple(point: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z
