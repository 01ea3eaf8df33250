"""Driving a model by hand is its rollout."""

from __future__ import annotations

import numpy as np
import torch
from planning.worlds import PerfectGridModel

from dmotion_bench.learning.driving import Drive, predicted
from dmotion_bench.learning.images import to_model, to_pixels
from recorders.grid_world import GridWorld

ACTIONS = [3, 3, 1, 0, 2, 1]


def test_a_drive_is_the_models_rollout_and_can_start_over() -> None:
    model = PerfectGridModel()
    start = torch.from_numpy(GridWorld().reset(seed=3)[0])
    drive = Drive(model, start)
    frames = torch.stack([drive.step(action) for action in ACTIONS])
    assert drive.actions == ACTIONS
    image = to_model(start[None])
    rollout = to_pixels(model.rollout(image, image, torch.tensor([ACTIONS])))[0]
    torch.testing.assert_close(frames, rollout)
    drive.restart()
    assert drive.actions == []
    torch.testing.assert_close(drive.frame, start)
    torch.testing.assert_close(drive.step(ACTIONS[0]), frames[0])


def test_a_perfect_model_drives_like_the_simulator() -> None:
    env = GridWorld()
    drive = Drive(PerfectGridModel(), torch.from_numpy(env.reset(seed=5)[0]))
    for action in np.random.default_rng(0).integers(0, 4, 20).tolist():
        np.testing.assert_array_equal(drive.step(action).numpy(), env.step(action)[0])


def test_predicted_frames_are_those_of_each_sequence() -> None:
    model, start = PerfectGridModel(), torch.from_numpy(GridWorld().reset(seed=3)[0])
    sequences = torch.tensor([ACTIONS, ACTIONS[::-1]])
    found = predicted(model, start, start, sequences)
    for sequence, frames in zip(sequences.tolist(), found, strict=True):
        drive = Drive(model, start)
        torch.testing.assert_close(frames, torch.stack([drive.step(action) for action in sequence]))
