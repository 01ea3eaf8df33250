"""A small recording of Grid World and its control tasks; a module may have others of its own."""

from __future__ import annotations

import pytest

from dmotion_bench.planning.tasks import Problem, load_problems
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("data") / "grid"
    record_dataset(folder, DatasetRecipe(environment="grid_world", policy="random", episodes=30, frames=32, tasks=6))
    return Dataset.open(folder)


@pytest.fixture(scope="module")
def problems(dataset: Dataset) -> list[Problem]:
    return load_problems(dataset)
