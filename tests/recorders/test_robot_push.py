"""The robot, the renderer and the physics of ``robot_push``, against Bullet's own kinematics and renderer."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import PackageNotInstalled
from dmotion_bench.specs import MASK_AGENT, MASK_FIRST_OBJECT
from recorders.push_policy import PushPolicy
from recorders.robot_push import RobotPush, panda
from recorders.robot_push.arm_layer import rasterise
from recorders.robot_push.camera import Camera
from recorders.robot_push.samples import SAMPLES
from recorders.robot_push.scene import LATTICE, TABLE, TABLE_THICKNESS
from recorders.robot_push.table_physics import ROD_BOTTOM, load_bullet

LIMITS = [(-2.8973, 2.8973), (-1.7628, 1.7628), (-2.8973, 2.8973), (-3.0718, -0.0698), (-2.8973, 2.8973)]
LIMITS += [(-0.0175, 3.7525), (-2.8973, 2.8973)]  # [rad], panda.urdf


@pytest.fixture(scope="module")
def bullet() -> Any:
    return load_bullet()


@pytest.fixture(scope="module")
def arm(bullet: Any) -> Iterator[tuple[int, int]]:
    """A Bullet client with the Panda of pybullet_data in it."""
    client = bullet.connect(bullet.DIRECT)
    urdf = Path(load_bullet("pybullet_data").getDataPath()) / "franka_panda" / "panda.urdf"
    yield client, bullet.loadURDF(str(urdf), useFixedBase=1, physicsClientId=client)
    bullet.disconnect(client)


def test_the_tip_reaches_every_place_with_the_rod_upright_and_the_joints_within_their_limits() -> None:
    for x in range(LATTICE.places[0]):
        for y in range(LATTICE.places[1]):
            tip = np.array([*LATTICE.at((x, y)), ROD_BOTTOM])
            joints = panda.joints_for(tip)
            frames = panda.link_frames(joints)
            np.testing.assert_allclose(panda.tip_of(frames), tip, atol=1e-5)
            np.testing.assert_allclose(frames[-1, :3, 2], [0, 0, -1], atol=1e-5)
            assert all(low < angle < high for angle, (low, high) in zip(joints, LIMITS, strict=True))


def test_the_links_are_where_bullet_has_them(bullet: Any, arm: tuple[int, int]) -> None:
    client, body = arm
    joints = panda.joints_for(np.array([0.6, -0.2, ROD_BOTTOM]))
    for joint, angle in enumerate(joints):
        bullet.resetJointState(body, joint, angle, physicsClientId=client)
    frames = panda.link_frames(joints)
    for link, frame in [*enumerate(frames[1:8]), (8, frames[8])]:
        state = bullet.getLinkState(body, link, computeForwardKinematics=1, physicsClientId=client)
        turn = np.array(bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        np.testing.assert_allclose(frame[:3, 3], state[4], atol=1e-6)
        np.testing.assert_allclose(frame[:3, :3], turn, atol=1e-5)


def test_masks_are_what_bullets_renderer_segments(bullet: Any, arm: tuple[int, int]) -> None:
    env, (client, body) = RobotPush(), arm
    env.reset(seed=4)
    policy, generator = PushPolicy(), np.random.default_rng(0)
    for _ in range(12):
        env.step(policy(env, generator))
    objects, camera = env.objects(), Camera()
    tip = env.agent().position[0]
    for joint, angle in enumerate(panda.joints_for(tip)):
        bullet.resetJointState(body, joint, angle, physicsClientId=client)
    for finger in (9, 10):  # the rod takes their place
        bullet.changeVisualShape(body, finger, rgbaColor=[0, 0, 0, 0], physicsClientId=client)

    def add(shape: int, place: list[float], quaternion: Any = (0, 0, 0, 1)) -> int:
        made: int = bullet.createMultiBody(0, -1, shape, place, quaternion, physicsClientId=client)
        return made

    half = [TABLE.size[0] / 2, TABLE.size[1] / 2, TABLE_THICKNESS / 2]
    add(
        bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=client),
        [*TABLE.center, -TABLE_THICKNESS / 2],
    )
    rod = add(
        bullet.createVisualShape(
            bullet.GEOM_CYLINDER, radius=panda.ROD_RADIUS, length=panda.ROD_LENGTH, physicsClientId=client
        ),
        [tip[0], tip[1], ROD_BOTTOM + panda.ROD_LENGTH / 2],
    )
    boxes = {"red_cube": (0.063, 0.063, 0.063), "blue_bar": (0.098, 0.053, 0.053), "cyan_slab": (0.077, 0.077, 0.05)}
    seen = {}
    for index, one in enumerate(env.facts.objects):
        if one.name in boxes:
            shape = bullet.createVisualShape(
                bullet.GEOM_BOX, halfExtents=[edge / 2 for edge in boxes[one.name]], physicsClientId=client
            )
            seen[index] = add(shape, objects.position[index].tolist(), objects.orientation[index].tolist())
    view = bullet.computeViewMatrixFromYawPitchRoll(camera.target, camera.distance, camera.yaw, camera.pitch, 0, 2)
    lens = bullet.computeProjectionMatrixFOV(camera.field_of_view, 1.0, 0.1, 5.0)
    picture = bullet.getCameraImage(
        512,
        512,
        view,
        lens,
        renderer=bullet.ER_TINY_RENDERER,
        flags=bullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX,
        physicsClientId=client,
    )
    # TinyRenderer draws half of its own pixel to the right and upward of where the camera's matrices say.
    segments = np.reshape(picture[4], (512, 512))[1::4, 2::4]
    drawn_body, link = np.where(segments < 0, -1, segments & 0xFFFFFF), (segments >> 24) - 1

    masks = env.masks()
    bare = ~np.isin(masks, [MASK_FIRST_OBJECT + k for k in range(6) if k not in seen])  # Bullet has the boxes alone
    expected = {MASK_AGENT: ((drawn_body == body) & (link >= 0)) | (drawn_body == rod)}
    expected |= {MASK_FIRST_OBJECT + index: drawn_body == drawn for index, drawn in seen.items()}
    for value, wanted in expected.items():
        overlap = ((masks == value) & wanted & bare).sum() / (((masks == value) | wanted) & bare).sum()
        assert overlap > (0.85 if value == MASK_AGENT else 0.95), value  # Bullet draws the arm's finer meshes
    env.close()


def test_visibility_is_the_share_of_the_silhouette_that_is_shown() -> None:
    env = RobotPush()
    hidden = []
    for seed in range(12):
        env.reset(seed=seed)
        for index, visible in enumerate(env.objects().visible):
            sprite = env._sprites[index]
            assert sprite is not None
            middle = SAMPLES // 2
            alone = sprite.covered[middle::SAMPLES, middle::SAMPLES].sum()
            shown = (env.masks() == MASK_FIRST_OBJECT + index).sum()
            assert abs(shown / alone - visible) < 0.06
            hidden.append(visible < 1)
    assert any(hidden)
    env.close()


@pytest.mark.parametrize("distractors", [0, 3])
def test_a_picture_is_the_same_as_one_that_is_drawn_from_nothing(distractors: int) -> None:
    env = RobotPush(distractors=distractors)
    env.reset(seed=4)
    generator, policy, kept = np.random.default_rng(0), PushPolicy(), 0
    for _ in range(60):
        env.step(policy(env, generator))
        decals = env._renderer._shown[:distractors]
        anew = env._make_renderer(env._renderer.camera, env._renderer.light)
        expected = anew.picture(env._place, env._sprites, decals)
        np.testing.assert_array_equal(env._picture.frame, expected.frame)
        np.testing.assert_array_equal(env._picture.masks, expected.masks)
        np.testing.assert_array_equal(env._picture.visible, expected.visible)
        assert env._picture.agent_visible == expected.agent_visible
        kept += len(env._renderer._patches)
    assert kept > 60  # so that much of it was not drawn from nothing
    env.close()


def test_the_last_of_equally_near_triangles_is_seen() -> None:
    triangle = np.array([[0.0, 0.0, 1.0], [6.0, 0.0, 1.0], [0.0, 6.0, 1.0]])
    nearer = triangle + np.array([0.0, 0.0, 0.5])
    for order, winner in (((triangle, triangle), 1), ((nearer, triangle), 0), ((triangle, nearer, nearer), 2)):
        assert set(rasterise(np.stack(order), 8)[2].tolist()) == {winner}


def test_a_triangle_covers_the_samples_whose_centres_lie_in_it() -> None:
    size, generator = 16, np.random.default_rng(0)
    triangles = np.concatenate([generator.uniform(-2, 18, (5, 3, 2)), generator.uniform(0.5, 1.0, (5, 3, 1))], axis=-1)
    samples, depth, owner = rasterise(triangles, size)
    at = (np.arange(size * SAMPLES) - (SAMPLES - 1) / 2) / SAMPLES
    points = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    best = np.zeros(len(points))
    for corners in triangles:
        weights = np.linalg.solve(
            np.concatenate([corners[:, :2].T, np.ones((1, 3))]), np.concatenate([points.T, np.ones((1, len(points)))])
        )
        inside = (weights >= 0).all(axis=0)
        best = np.where(inside, np.maximum(best, weights.T @ corners[:, 2]), best)
    np.testing.assert_array_equal(samples, np.flatnonzero(best > 0))
    np.testing.assert_allclose(depth, best[samples], rtol=1e-5)
    assert set(owner) <= set(range(5))


@pytest.mark.slow
def test_a_step_ends_at_rest_with_the_tip_in_its_place_and_nothing_overlapping(bullet: Any) -> None:
    env = RobotPush()
    physics = env._physics
    overlaps = []
    for seed in range(4):
        env.reset(seed=seed)
        policy, generator = PushPolicy(), np.random.default_rng(seed)
        for _ in range(40):
            if env.step(policy(env, generator))[2]:
                break
            assert physics.at_rest
            assert (physics.speeds() == 0).all()
            assert physics.rod == pytest.approx(tuple(env.agent().position[0, :2]), abs=1e-9)
            contacts = bullet.getContactPoints(physicsClientId=physics._client)
            overlaps += [-contact[8] for contact in contacts]
    assert max(overlaps) < 2e-3  # [m]
    env.close()


def test_objects_stand_upright_when_pushed() -> None:
    env = RobotPush()
    upright = []
    for seed in range(4):
        env.reset(seed=seed)
        policy, generator = PushPolicy(), np.random.default_rng(seed)
        for _ in range(30):
            env.step(policy(env, generator))
        x, y = env.objects().orientation[:, 0], env.objects().orientation[:, 1]
        tilt = 1 - 2 * (x**2 + y**2)
        upright += tilt[~np.isnan(tilt)].tolist()
    assert np.mean(np.array(upright) > 0.99) > 0.9
    env.close()


def test_without_pybullet_the_command_that_installs_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(PackageNotInstalled, match=r"pip install 'dmbench\[robot\]'"):
        RobotPush()
