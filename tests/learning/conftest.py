"""A small data set in memory, with what the learning code asks of a data set, and one on disk with a training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from learning.short_training import short_run, train_short
from walking_square import record_walks

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.specs import DatasetRecipe, EnvSpec, ObjectSpec, ObjectStates, SplitName
from dmotion_bench.storage.messages import StateLabels
from dmotion_bench.storage.tables import EpisodeTable

SIZE = 16
LENGTHS = (6, 9, 3, 7, 5, 8, 6, 6, 4, 7)


@dataclass
class FramesInMemory:
    frames: np.ndarray
    offsets: np.ndarray

    @property
    def nbytes(self) -> int:
        return int(self.frames.nbytes)

    def checked(self, first: np.ndarray, length: int) -> np.ndarray:
        return self.frames


class DatasetInMemory:
    """Ten short episodes of noise with known actions; ``opened`` records whose labels were read."""

    path, name, fingerprint = Path("noise"), "noise", "0" * 64
    recipe = DatasetRecipe(environment="noise", episodes=len(LENGTHS), frames=max(LENGTHS))
    rows = EpisodeTable.of([])

    def __init__(self) -> None:
        generator = np.random.default_rng(7)
        frames = generator.integers(0, 256, (sum(LENGTHS), SIZE, SIZE, 3), dtype=np.uint8)
        self._cache = FramesInMemory(frames, np.concatenate([[0], np.cumsum(LENGTHS)]))
        self.spec = EnvSpec(
            id="noise",
            actions=Discrete(("left", "right")),
            agent=ObjectSpec(name="agent", shape="dot", color=(0, 255, 0)),
            objects=(),
            height=SIZE,
            width=SIZE,
        )
        self.actions = [generator.integers(0, 2, length - 1) for length in LENGTHS]
        self.pushed = [generator.random(length - 1) < 0.3 for length in LENGTHS]
        self.opened: list[int] = []

    def __len__(self) -> int:
        return len(LENGTHS)

    def cache(self) -> FramesInMemory:
        return self._cache

    def split(self, name: SplitName) -> np.ndarray:
        return {"train": np.arange(0, 7), "validation": np.array([7]), "test": np.array([8, 9])}[name]

    def tasks(self) -> NoReturn:
        raise AssertionError("learning asks for no tasks")

    def video(self, episode: int) -> NoReturn:
        raise AssertionError("learning reads frames from the cache")

    def labels(self, episode: int) -> NoReturn:
        raise AssertionError("learning reads no masks")

    def states(self, episode: int) -> StateLabels:
        self.opened.append(episode)
        nothing = ObjectStates(
            position=np.zeros((LENGTHS[episode], 0, 3)),
            orientation=np.zeros((LENGTHS[episode], 0, 4)),
            pixel=np.zeros((LENGTHS[episode], 0, 2)),
            visible=np.zeros((LENGTHS[episode], 0)),
        )
        return StateLabels(
            actions=self.actions[episode],
            pushed=self.pushed[episode],
            agent=nothing,
            objects=nothing,
            factors={},
        )


@pytest.fixture
def dataset() -> DatasetInMemory:
    return DatasetInMemory()


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read only."""
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


@pytest.fixture(scope="session")
def trained(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A short training on it; read only."""
    run = short_run(recorded, tmp_path_factory.mktemp("runs") / "whole")
    train_short(run, recorded)
    return run
