"""The position finder against the simulators' true centres, by how much of an object is seen.

``docs/experiments/position-finder.md`` has the figures of whole data sets.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dmotion_bench.positions import PositionFinder
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset

EPISODES = 12


def _sightings(
    path: Path, environment: str, policy: str, **parameters: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every object in every frame: the share that is seen, whether it is found, and how far off [px]."""
    recipe = DatasetRecipe(environment=environment, parameters=parameters, policy=policy, episodes=EPISODES, frames=40)
    record_dataset(path, recipe)
    dataset = Dataset.open(path)
    finder, rows = PositionFinder(dataset.spec), []
    for episode in range(len(dataset)):
        objects = dataset.states(episode).objects
        found = finder.find(torch.from_numpy(dataset.video(episode)))
        count = objects.visible.shape[1]
        error = np.linalg.norm(found.centre.numpy()[:, :count] - objects.pixel, axis=-1)
        rows.append(np.stack([np.nan_to_num(objects.visible), found.found.numpy()[:, :count], error], axis=-1))
    seen, found_at, error = np.concatenate(rows).reshape(-1, 3).T
    return seen, found_at.astype(bool), error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "parameters", "policy", "median", "most"),
    [
        ("grid_world", {}, "random", 0.0, 0.0),
        ("grid_world", {"version": 2}, "random", 0.0, 0.0),
        ("planar_push", {}, "push", 0.1, 0.3),
        ("push_t", {}, "push", 0.15, 0.45),
        ("robot_push", {}, "push", 0.15, 0.4),
    ],
)
def test_what_is_seen_whole_is_found_and_what_is_not_seen_never(
    tmp_path: Path, environment: str, parameters: dict[str, int], policy: str, median: float, most: float
) -> None:
    seen, found, error = _sightings(tmp_path / "data", environment, policy, **parameters)
    whole = seen > 0.999

    assert whole.sum() > 450
    assert found[whole].all()
    assert not found[seen == 0].any()
    assert np.median(error[whole]) <= median + 1e-5
    assert np.percentile(error[whole], 95) <= most + 1e-5


@pytest.mark.slow
def test_the_less_is_seen_the_farther_off_it_is(tmp_path: Path) -> None:
    seen, found, error = _sightings(tmp_path / "data", "robot_push", "push")
    medians = [
        np.median(error[found & (seen > low) & (seen <= high)]) for low, high in ((0.9, 1), (0.6, 0.9), (0.2, 0.6))
    ]

    assert medians == sorted(medians)
    assert medians[-1] < 5
