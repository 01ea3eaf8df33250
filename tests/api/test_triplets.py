"""Triplets of a data set's split, for a training loop of one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import dmotion_bench as dm
from dmotion_bench.errors import LabelsNotAvailable, UnknownName, UsageError
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import TripletBatch
from dmotion_bench.registry import model_class


def test_triplets_are_three_consecutive_frames_of_the_split(workspace: Path) -> None:
    dataset = dm.open_dataset(str(workspace / "data" / "grid_world-tiny"))
    for split in ("train", "validation", "test"):
        triplets = dataset.triplets(split)
        assert len(triplets) == 10 * len(dataset.split(split))
        assert repr(triplets) == f"<TripletDataset: {len(triplets)} triplets, without actions>"
        place = len(triplets) // 2
        sample = triplets[place]
        episode, step = int(triplets.triplets.episode[place]), int(triplets.triplets.step[place])
        assert episode in dataset.split(split).tolist()
        frames = to_model(torch.from_numpy(dataset.video(episode)[step - 1 : step + 2]))
        shown = torch.stack([sample["previous"], sample["current"], sample["next"]])
        assert torch.equal(shown, frames)
        assert sample.keys() == {"previous", "current", "next", "episode"}
        assert torch.equal(triplets[place - len(triplets)]["next"], sample["next"])
        with pytest.raises(IndexError):
            triplets[len(triplets)]


@pytest.mark.slow
def test_a_plain_data_loader_makes_batches_that_a_model_learns_from(workspace: Path) -> None:
    triplets = dm.open_dataset().triplets("train", labels="all")
    batch = next(iter(DataLoader(triplets, batch_size=4, shuffle=False)))
    kind = model_class("ed-cnn")
    run = dm.train("ed-cnn", labels="all", settings={"epochs": 0.1})
    losses = run.model.losses(TripletBatch(**batch))
    assert torch.isfinite(losses.total)
    assert isinstance(run.model, kind)
    assert batch["action"].tolist() == triplets.actions[:4].tolist()  # type: ignore[index]


def test_labels_of_triplets_are_those_that_the_budget_pays_for(workspace: Path) -> None:
    dataset = dm.open_dataset()
    triplets = dataset.triplets("train", labels=16, seed=3)
    paid = LabelBudget(dataset, LabelRequest.parse("16"), 3).actions(TripletSet.of_split(dataset, "train"), "training")
    assert triplets.actions is not None
    assert np.array_equal(triplets.actions, paid.actions)
    for place in range(len(triplets)):
        episode, step = int(triplets.triplets.episode[place]), int(triplets.triplets.step[place])
        assert triplets[place]["action"] == dataset.labels(episode).actions[step]
    with pytest.raises(UsageError, match="labels no model may learn from"):
        dataset.triplets("test", labels="all")
    with pytest.raises(UnknownName, match="no split named 'tset'"):
        dataset.triplets("tset")  # type: ignore[arg-type]


def test_no_labels_and_demonstrations_are_asked_for_in_python_s_words(workspace: Path) -> None:
    dataset = dm.open_dataset()
    for split in ("train", "test"):
        assert dataset.triplets(split, labels="none")[0].keys() == {"previous", "current", "next", "episode"}
        assert len(dataset.triplets(split, labels="none")) == len(dataset.triplets(split))
    with pytest.raises(LabelsNotAvailable, match=r"labels='one-shot' are demonstrations.*or labels=\"all\"\."):
        dataset.triplets("train", labels="one-shot")


def test_video_alone_is_read_where_there_are_no_labels(workspace: Path) -> None:
    for file in (workspace / "data" / "grid_world-tiny" / "labels").glob("*"):
        file.unlink()
    assert len(dm.open_dataset().triplets("train")) > 0
    with pytest.raises(LabelsNotAvailable):
        dm.open_dataset().triplets("train", labels="all")
