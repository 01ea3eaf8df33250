"""The items of a data set, as torch and a plain loop ask for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch.utils.data import DataLoader, Subset

import dmotion_bench as dm
from dmotion_bench.errors import UsageError


def test_an_item_is_an_episode_s_video_and_no_label_is_read(workspace: Path) -> None:
    dataset = dm.open_dataset()
    videos = [dataset.video(episode) for episode in range(len(dataset))]
    for file in (workspace / "data" / "grid_world-tiny" / "labels").glob("*"):
        file.unlink()
    for items in (list(dataset), [dataset[episode] for episode in range(len(dataset))]):
        assert all(np.array_equal(item, video) for item, video in zip(items, videos, strict=True))
    assert np.array_equal(dataset[-1], videos[-1])
    assert np.array_equal(dataset[np.int64(3)], videos[3])


def test_torch_loads_the_videos_of_a_split(workspace: Path) -> None:
    dataset = dm.open_dataset()
    loaded = list(DataLoader(Subset(dataset, dataset.split("test").tolist()), batch_size=None))
    assert [video.numpy().tobytes() for video in loaded] == [
        dataset.video(int(episode)).tobytes() for episode in dataset.split("test")
    ]


def test_an_item_that_is_not_there_is_refused(workspace: Path) -> None:
    dataset = dm.open_dataset()
    for items, what in ((dataset, "episode"), (dataset.triplets("train"), "triplet")):
        for number in (len(items), -len(items) - 1):
            with pytest.raises(IndexError, match=f"there is no {what} {number}; there are {len(items)}"):
                items[number]
        for wrong in (slice(0, 2), "first", 1.5, True):
            given: Any = wrong
            with pytest.raises(UsageError, match=f"{what} is .*; it must be a whole number"):
                items[given]
