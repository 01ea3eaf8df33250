"""Batches hold every held-out transition once, whole, whatever their size."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.errors import DatasetError, LabelsNotAvailable
from dmotion_bench.scoring.transitions import STARTS_PER_EPISODE, HeldOut, rollout_starts
from dmotion_bench.specs import MASK_AGENT, EpisodeLabels
from dmotion_bench.storage.dataset import Dataset

from .conftest import FRAMES, write_dataset


@pytest.mark.parametrize("size", [1, 7, 12, 1000])
def test_batches_are_the_episodes_own_frames_and_labels(grid: Dataset, size: int) -> None:
    seen = []
    for batch in HeldOut(grid, "test").batches(size):
        assert len(batch) <= size
        for row in range(len(batch)):
            episode, step = int(batch.episode[row]), int(batch.step[row])
            video, labels = grid.video(episode), grid.labels(episode)
            seen.append((episode, step))
            np.testing.assert_array_equal(batch.frames[row], video[step - 1 : step + 2])
            np.testing.assert_array_equal(batch.agent[row], labels.masks[step : step + 2] == MASK_AGENT)
            assert batch.action[row] == labels.actions[step]
            assert batch.pushed[row] == labels.pushed[step]
            assert batch.shifts[row, 0] == pytest.approx(labels.agent.pixel[step + 1, 0] - labels.agent.pixel[step, 0])

    assert seen == [(episode, step) for episode in grid.split("test").tolist() for step in range(1, FRAMES - 1)]


def test_one_episode_is_read_at_a_time(grid: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    labels = Dataset.labels

    def watched(self: Dataset, episode: int) -> EpisodeLabels:
        read.append(episode)
        return labels(self, episode)

    monkeypatch.setattr(Dataset, "labels", watched)
    batches = HeldOut(grid, "test").batches(FRAMES - 2)

    for number in range(1, 4):
        next(batches)
        assert len(read) == number


def test_rollouts_follow_the_recorded_actions(grid: Dataset) -> None:
    horizon = 5
    held_out = HeldOut(grid, "test")
    starts = []
    for batch in held_out.rollouts(horizon, 5):
        for row, (episode, start) in enumerate(zip(batch.episode.tolist(), batch.start.tolist(), strict=True)):
            video, states = grid.video(episode), grid.states(episode)
            starts.append((episode, start))
            np.testing.assert_array_equal(batch.previous[row], video[start - 1])
            np.testing.assert_array_equal(batch.current[row], video[start])
            np.testing.assert_array_equal(batch.future[row], video[start + 1 : start + 1 + horizon])
            np.testing.assert_array_equal(batch.actions[row], states.actions[start : start + horizon])
            np.testing.assert_array_equal(batch.pushed[row], states.pushed[start : start + horizon])

    assert len(starts) == held_out.count_rollouts(horizon) == 3 * STARTS_PER_EPISODE
    assert {start for _, start in starts} == set(rollout_starts(FRAMES, horizon).tolist())


@settings(deadline=None, derandomize=True)
@given(frames=st.integers(1, 60), horizon=st.integers(1, 20))
def test_rollouts_begin_where_they_can_end(frames: int, horizon: int) -> None:
    starts = rollout_starts(frames, horizon)
    possible = [start for start in range(frames) if start >= 1 and start + horizon <= frames - 1]

    assert set(starts.tolist()) <= set(possible)
    assert len(starts) == min(STARTS_PER_EPISODE, len(possible))
    if possible:
        assert starts[0] == possible[0]
        assert len(possible) == 1 or starts[-1] == possible[-1]


def test_the_leaking_split_is_the_training_s(grid: Dataset) -> None:
    leaking = HeldOut(grid, "test", "paper")
    triplets = 30 * (FRAMES - 2)
    rows = [(int(e), int(s)) for batch in leaking.batches(50) for e, s in zip(batch.episode, batch.step, strict=True)]

    assert len(rows) == len(set(rows)) == triplets // 10
    assert len({episode for episode, _ in rows}) > 10


def test_unknown_actions_and_empty_splits_are_said(grid: Dataset, tmp_path: Path) -> None:
    nameless = Dataset.open(grid.path)
    nameless.spec = dataclasses.replace(grid.spec, actions=None)
    with pytest.raises(LabelsNotAvailable, match="actions of 'grid_world-tiny' are not known"):
        HeldOut(nameless, "test")
    with pytest.raises(DatasetError, match="no triplet; record more"):
        HeldOut(write_dataset(tmp_path / "one", episodes=1, frames=4), "test")


@pytest.mark.parametrize("size", [7, 12, 1000])
def test_batches_without_masks_are_the_same_otherwise(grid: Dataset, size: int) -> None:
    held_out = HeldOut(grid, "test")
    for batch, bare in zip(held_out.batches(size), held_out.batches(size, masks=False), strict=True):
        assert bare.masks is None
        for field in dataclasses.fields(batch):
            if field.name != "masks":
                np.testing.assert_array_equal(getattr(batch, field.name), getattr(bare, field.name))
