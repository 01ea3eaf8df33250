"""Where Robot Push is seen from: other cameras show the same states, and what the arm hides is measured rightly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.recording.rollout import record_episode
from recorders.push_policy import PushPolicy
from recorders.robot_push import RobotPush
from recorders.robot_push.camera import Camera
from recorders.robot_push.occlusion import MARGIN, VISIBLE, fitting, moments, occlusion
from recorders.robot_push.scene import TABLE


def test_another_camera_shows_the_same_episode() -> None:
    usual = record_episode(RobotPush(), PushPolicy(), 3, 4)
    named = record_episode(RobotPush(pitch=-52.0, distance=1.5, field_of_view=26.0), PushPolicy(), 3, 4)
    other = record_episode(RobotPush(pitch=-40.0, distance=4.0, field_of_view=9.9), PushPolicy(), 3, 4)

    np.testing.assert_array_equal(named.frames, usual.frames)
    np.testing.assert_array_equal(other.labels.actions, usual.labels.actions)
    np.testing.assert_array_equal(other.labels.objects.position, usual.labels.objects.position)
    assert (other.frames != usual.frames).any()


@pytest.mark.parametrize("setting", [{"pitch": 3.0}, {"distance": 0.1}, {"field_of_view": 170.0}])
def test_a_camera_that_cannot_be_is_refused(setting: dict[str, float]) -> None:
    with pytest.raises(InvalidSetting, match=f"{next(iter(setting))} is .*; it can be"):
        RobotPush(**setting)


def test_what_is_hidden_is_what_the_labels_of_a_recording_say() -> None:
    seen = moments(2, 12, seed=5)
    env = RobotPush()
    visible = [record_episode(env, PushPolicy(), seed, 12).labels.objects.visible[::2].reshape(-1) for seed in (5, 6)]
    env.close()
    found = occlusion(Camera(), seen)

    assert len(seen) == sum(len(one) for one in visible) / 6
    assert found.hidden == pytest.approx((np.concatenate(visible) < VISIBLE).mean())
    assert found.without_arm <= found.hidden


def test_a_fitting_camera_just_holds_the_table() -> None:
    camera = fitting(Camera(pitch=-40.0, distance=4.0))
    corners = np.array(
        [
            (TABLE.center[0] + x * TABLE.size[0] / 2, TABLE.center[1] + y * TABLE.size[1] / 2, 0.0)
            for x in (-1, 1)
            for y in (-1, 1)
        ]
    )
    wide, narrow = (one.project(corners)[:, :2] for one in (camera, replace(camera, field_of_view=8.0)))

    assert wide.min() >= MARGIN
    assert wide.max() <= camera.size - 1 - MARGIN
    assert narrow.min() < MARGIN or narrow.max() > camera.size - 1 - MARGIN
