"""The drawing and the physics of ``planar_push``, against geometry done another way."""

from __future__ import annotations

import numpy as np
import pytest

from recorders.planar_push import PlanarPush
from recorders.planar_push.drawing import View, stamp
from recorders.planar_push.shapes import SHAPES, circle
from recorders.planar_push.table_physics import MOVING, RATE, Piece, PlanarPhysics
from recorders.push_policy import PushPolicy

AREAS = {"square": 0.065**2, "circle": np.pi * 0.037**2, "bar": 0.1 * 0.05}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("turn", [0.0, 10.0])
def test_a_stamps_coverage_adds_up_to_the_shapes_area(shape: str, turn: float) -> None:
    view, one = View(turn=turn), SHAPES[shape]
    corners = one.corners
    if shape in AREAS:
        area = AREAS[shape]
    else:
        after = np.roll(corners, -1, axis=0)
        area = 0.5 * float((corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]).sum())
    for angle in np.linspace(0, 2, 7):
        drawn = stamp(view, one, np.array([0.031, -0.017]), float(angle), (200, 100, 50))
        assert drawn is not None
        assert drawn.coverage.sum() / 256 == pytest.approx(area * view.scale**2, rel=0.03)
        y, x = np.indices(drawn.coverage.shape)
        weight = drawn.coverage / drawn.coverage.sum()
        middle = (x * weight).sum() + drawn.window[1].start, (y * weight).sum() + drawn.window[0].start
        np.testing.assert_allclose(middle, view.project(np.array([0.031, -0.017])), atol=0.1)


def test_the_picture_turns_as_the_shape_does() -> None:
    view, bar = View(), SHAPES["bar"]
    drawn = stamp(view, bar, np.zeros(2), np.pi / 6, (200, 100, 50))
    assert drawn is not None
    y, x = np.nonzero(drawn.inside)
    spread = np.cov(x, -y)  # up is up
    values, vectors = np.linalg.eigh(spread)
    along = vectors[:, values.argmax()]
    assert np.arctan2(along[1], along[0]) % np.pi == pytest.approx(np.pi / 6, abs=0.05)


def test_a_circle_pushed_through_its_middle_goes_ahead_of_the_disc() -> None:
    physics = PlanarPhysics(size=(0.52, 0.52), disc=0.025)
    piece = Piece(shape=circle(0.037), mass=0.15, friction=0.5, position=(0.0, 0.0), angle=0.0)
    physics.build([piece], disc=(-0.08, 0.0))
    speed = 0.04 * RATE / MOVING
    slide = speed**2 / (2 * piece.friction * 9.81)  # Coulomb, after the disc has stopped
    for x in (-0.04, 0.0, 0.04):
        physics.move((x, 0.0))
        assert physics.positions[0, 0] == pytest.approx(x + 0.062 + slide, abs=1e-3)
        assert physics.positions[0, 1] == pytest.approx(0.0, abs=1e-6)
        assert (physics.speeds() == 0).all()


def test_a_shape_whose_centre_leaves_the_table_has_fallen() -> None:
    physics = PlanarPhysics(size=(0.2, 0.2), disc=0.025)
    piece = Piece(shape=circle(0.037), mass=0.15, friction=0.5, position=(0.06, 0.0), angle=0.0)
    physics.build([piece], disc=(-0.01, 0.0))
    physics.move((0.03, 0.0))
    assert not physics.fallen.any()
    physics.move((0.07, 0.0))
    assert physics.fallen.all()
    assert np.isnan(physics.positions).all()
    physics.move((0.03, 0.0))  # nothing is left to push


def test_no_two_shapes_ever_show_the_same_place() -> None:
    env = PlanarPush()
    for seed in range(5):
        env.reset(seed=seed)
        policy, generator = PushPolicy(), np.random.default_rng(seed)
        for _ in range(30):
            env.step(policy(env, generator))
            inside = np.zeros((128, 128), int)
            for one in env._stamps:
                if one is not None:
                    inside[one.window] += one.inside
            assert (inside > 1).sum() <= 2  # [px], where two touch
