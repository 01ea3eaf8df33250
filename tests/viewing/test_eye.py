"""The world is looked at from the side that is down in the camera's picture."""

from __future__ import annotations

import numpy as np
import pytest

from dmotion_bench.viewing.eye import eye_of_camera

PLACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, 2.0, 0.1], [np.nan, 0.0, 0.0]])


@pytest.mark.parametrize("down", [(1, 0), (0, 1), (-1, 0), (0, -1), (0.6, 0.8)])
def test_what_is_lower_in_the_picture_is_nearer_to_the_eye(down: tuple[float, float]) -> None:
    along = np.array(down)
    across = np.array([-along[1], along[0]])
    pixel = np.stack([PLACES[:, :2] @ across, PLACES[:, :2] @ along], axis=1) * 30 + 64
    eye = eye_of_camera(PLACES, pixel)
    assert eye is not None
    np.testing.assert_allclose(eye.target, (0.5, 1.0, 0.05))
    direction = np.array(eye.position) - eye.target
    np.testing.assert_allclose(direction[:2] / np.linalg.norm(direction[:2]), along, atol=1e-9)
    assert direction[2] * eye.up[2] > 0


@pytest.mark.parametrize("down", [(1.0, 0.0), (0.6, 0.8), (0.0, -1.0)])
@pytest.mark.parametrize("mirrored", [False, True])
def test_what_is_right_in_the_picture_is_right_for_the_eye(down: tuple[float, float], mirrored: bool) -> None:
    along = np.array(down)
    right = np.array([-along[1], along[0]]) * (-1 if mirrored else 1)
    eye = eye_of_camera(PLACES, np.stack([PLACES[:, :2] @ right, PLACES[:, :2] @ along], axis=1))
    assert eye is not None
    forward = np.array(eye.target) - eye.position
    to_the_right = np.cross(forward, eye.up)
    assert to_the_right[:2] @ right > 0


def test_too_few_places_tell_nothing() -> None:
    line = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, 2.0, 0.0]])
    assert eye_of_camera(line, line[:, :2]) is None
    assert eye_of_camera(PLACES[:2], PLACES[:2, :2]) is None
    assert eye_of_camera(np.zeros((5, 3)), np.zeros((5, 2))) is None
