"""A recorded Grid World of 30 short episodes, and models of it whose every figure is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from known_model import Known, NoConfig, write_run
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from recorders.grid_things import FACTS
from recorders.grid_world import GridWorld

FRAMES = 14


class Oracle(Known):
    """Looks the next frame up, and may spoil it."""

    def __init__(self, dataset: Dataset, spoil: Callable[[np.ndarray], np.ndarray] = lambda frame: frame) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
        self.spoil = spoil
        self.answers: dict[tuple[bytes, int], np.ndarray] = {}
        for episode in range(len(dataset)):
            frames, actions = dataset.video(episode), dataset.states(episode).actions
            for frame, action, following in zip(frames, actions.tolist(), frames[1:], strict=False):
                self.answers[frame.tobytes(), action] = following

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        seen = to_pixels(current).numpy()
        frames = [
            self.spoil(self.answers[frame.tobytes(), one]) for frame, one in zip(seen, action.tolist(), strict=True)
        ]
        return to_model(torch.from_numpy(np.stack(frames)))


def write_dataset(path: Path, *, episodes: int = 30, frames: int = FRAMES, seed: int = 3, version: int = 2) -> Dataset:
    parameters = {} if version == 1 else {"version": version}
    recipe = DatasetRecipe(environment="grid_world", parameters=parameters, seed=seed, episodes=episodes, frames=frames)
    with DatasetWriter.create_or_resume(path, recipe, FACTS) as writer:
        for shard in writer.missing:
            writer.write_shard(shard, record_episodes(GridWorld, recipe, writer.episodes_of(shard)))
        writer.finish()
    return Dataset.open(path)


@pytest.fixture(scope="session")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_dataset(tmp_path_factory.mktemp("data") / "grid_world-tiny")


@pytest.fixture
def copy_last() -> Known:
    return Known(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))


@pytest.fixture
def oracle(grid: Dataset) -> Oracle:
    return Oracle(grid)


@pytest.fixture
def without_red(grid: Dataset) -> Oracle:
    """Sees the future, but the red circle is gone from it."""

    def spoil(frame: np.ndarray) -> np.ndarray:
        red = (frame == (255, 0, 0)).all(axis=-1, keepdims=True)
        return np.where(red, 0, frame).astype(np.uint8)

    return Oracle(grid, spoil)


@pytest.fixture
def make_run(grid: Dataset, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Makes finished runs of a model that predicts the current frame, brightened by ``offset``."""
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)

    def make(path: Path, **changes: Any) -> Run:
        return write_run(path, grid, **changes)

    return make
