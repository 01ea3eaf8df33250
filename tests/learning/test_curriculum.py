"""Phases follow each other; each has its own share of the triplets, and batches of its own size if it wants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from dmotion_bench.learning.data import curriculum
from dmotion_bench.learning.data.batches import FramesOnDevice
from dmotion_bench.learning.data.curriculum import (
    TrainingData,
    demonstrations_of,
    labels_given,
    parts_of,
    steps_before_labels,
)
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import Phase, TrainingConfig
from dmotion_bench.specs import Supervision


def test_each_phase_has_its_share_of_the_triplets_whatever_its_batches(dataset) -> None:
    data = TrainingData(
        train=TripletSet.of_split(dataset, "train"),
        validation=TripletSet.of_split(dataset, "validation"),
        budget=LabelBudget(dataset, LabelRequest.parse("100%"), seed=0),
    )
    triplets = len(data.train)
    phases = (
        Phase(name="large", fraction=0.25, needs_actions=True),
        Phase(name="small", fraction=0.75, batch_size=2),
    )
    config = TrainingConfig(epochs=8.0, learning_rate=1e-3, batch_size=triplets // 3)
    large, small = parts_of(phases, data, config, seed=0, device=torch.device("cpu"))
    assert (large.start, large.stop, small.start) == (0, 6, 6)
    assert [len(part.order.batch(0)) for part in (large, small)] == [triplets // 3, 2]
    assert (small.stop - small.start) * 2 == 0.75 * 8 * triplets
    assert large.batches(large.order.batch(0)).action is not None
    assert small.batches(small.order.batch(0)).action is None


CPU = torch.device("cpu")
CONFIG = TrainingConfig(epochs=2.0, batch_size=4)


def _data(dataset, labels: str) -> TrainingData:
    return TrainingData(
        train=TripletSet.of_split(dataset, "train"),
        validation=TripletSet.of_split(dataset, "validation"),
        budget=LabelBudget(dataset, LabelRequest.parse(labels), seed=0),
    )


@pytest.mark.parametrize(
    ("supervision", "labels"),
    [
        *((Supervision.NONE, labels) for labels in ("none", "one-shot", "3", "50%", "100%")),
        (Supervision.FEW, "3"),
        *((Supervision.ACTIONS, labels) for labels in ("1", "2", "9", "30%", "100%")),
    ],
)
def test_the_labels_of_a_budget_are_counted_as_a_training_is_given_them(
    dataset, supervision: Supervision, labels: str
) -> None:
    data, apart = _data(dataset, labels), _data(dataset, labels)
    shown = demonstrations_of(data, supervision, CPU)
    if supervision is not Supervision.NONE:
        parts_of((Phase(name="labelled", needs_actions=True),), data, CONFIG, 0, CPU, shown)
    assert isinstance(apart.train, TripletSet)
    assert isinstance(apart.validation, TripletSet)

    assert labels_given(apart.train, apart.validation, apart.budget, supervision) == data.budget.given
    assert data.budget.total > 0 or labels == "none"


def test_few_labels_stand_beside_each_batch_of_video_and_the_step_decides_which(dataset) -> None:
    data = _data(dataset, "5")
    shown = demonstrations_of(data, Supervision.FEW, CPU)
    assert shown is not None
    phases = (Phase(name="video", fraction=0.5, with_labels=2), Phase(name="rest", fraction=0.5))
    parts = parts_of(phases, data, CONFIG, 0, CPU, shown)
    again = parts_of(phases, data, CONFIG, 0, CPU, shown)

    seen = []
    for step in (0, 1, 2, 1):
        batches = []
        for part in (parts[0], again[0]):
            part.batches.expect(step, 0, 1)
            batches.append(part.batches(part.order.batch(step)))
        first, second = batches
        assert first.action is None
        assert first.labelled is not None
        assert second.labelled is not None
        assert torch.equal(first.labelled.current, second.labelled.current)
        assert len(first.labelled) == 2
        seen.append(first.labelled)
    assert torch.equal(seen[1].current, seen[3].current)
    assert not torch.equal(seen[0].current, seen[1].current)
    for some in seen:
        for image, action in zip(some.current, some.action, strict=True):
            (row,) = (shown.current == image).all(dim=(1, 2, 3)).nonzero()[:, 0].tolist()
            assert shown.action[row] == action
    assert parts[1].batches(np.array([0])).labelled is None
    assert parts[0].validation(np.array([0])).labelled is None
    assert data.budget.given == {"demonstrations": 5}
    assert steps_before_labels(parts) is None


def test_a_phase_of_few_labels_alone_sees_the_demonstrations_alone(dataset) -> None:
    data = _data(dataset, "3")
    shown = demonstrations_of(data, Supervision.FEW, CPU)
    assert shown is not None
    phases = (Phase(name="named", fraction=0.5, needs_actions=True), Phase(name="video", fraction=0.5))
    named, video = parts_of(phases, data, CONFIG, 0, CPU, shown)
    batch = named.batches(named.order.batch(0))
    assert sorted(batch.action.tolist()) == sorted(shown.action.tolist())
    assert len(named.batches) == len(named.validation) == 3
    assert video.batches(video.order.batch(0)).action is None
    assert data.budget.given == {"demonstrations": 3}


@pytest.mark.parametrize(("labels", "train", "held"), [("1", 1, 1), ("2", 1, 1), ("16", 14, 2)])
def test_one_label_trains_and_validates_and_is_counted_once(dataset, labels, train, held) -> None:
    data = _data(dataset, labels)
    (part,) = parts_of((Phase(needs_actions=True),), data, CONFIG, 0, CPU)
    assert (len(part.batches), len(part.validation)) == (train, held)
    assert data.budget.total == int(labels)
    if labels == "1":
        own, also = part.batches(np.array([0])), part.validation(np.array([0]))
        assert torch.equal(own.current, also.current)


def test_a_phase_is_given_the_frames_before_its_triplets_and_an_episodes_first_one_again(dataset) -> None:
    data = _data(dataset, "none")
    phases = (Phase(name="far", fraction=0.5, earlier=3), Phase(name="near", fraction=0.5))
    far, near = parts_of(phases, data, CONFIG, 0, CPU)
    index, cache = np.arange(len(data.train)), dataset.cache()
    batch = far.batches(index)
    assert batch.earlier is not None
    assert batch.earlier.shape == (len(index), 3, *batch.current.shape[1:])
    for row, (episode, step) in enumerate(zip(*data.train.places(index), strict=True)):
        frames = to_model(torch.from_numpy(cache.frames[cache.offsets[episode] : cache.offsets[episode + 1]]))
        assert torch.equal(batch.previous[row], frames[step - 1])
        for image, back in zip(batch.earlier[row], (4, 3, 2), strict=True):
            assert torch.equal(image, frames[max(0, step - back)])
        assert batch.history[row] == min(step - 1, 3)
    assert batch.earlier_action is None
    assert near.batches(index).earlier is None
    assert far.validation(np.array([0])).earlier is None


@pytest.mark.parametrize("protocol", ["episode", "paper"])
def test_a_phase_of_labels_is_given_the_actions_before_its_triplets_that_were_paid_for(dataset, protocol) -> None:
    """The paper's split leaves gaps: what comes before a triplet may be another part's."""
    train = TripletSet.of_split(dataset, "train", protocol)
    data = replace(_data(dataset, "100%"), train=train)
    (part,) = parts_of((Phase(needs_actions=True, earlier=3),), data, CONFIG, 0, CPU)
    batch = part.batches(np.arange(len(train)))
    paid = {*zip(*(places.tolist() for places in train.places(np.arange(len(train)))), strict=True)}
    found = set()
    for row, (episode, step) in enumerate(zip(*train.places(np.arange(len(train))), strict=True)):
        actions, known = dataset.states(episode).actions, 0
        while known < 3 and (episode, step - known - 1) in paid:
            known += 1
        assert batch.history[row] == known
        wanted = [actions[step - min(back, known)] for back in (3, 2, 1)]
        assert batch.earlier_action[row].tolist() == wanted
        found.add((known, min(step - 1, 3)))
    assert len(found) > (4 if protocol == "paper" else 3)


def test_all_batches_of_a_training_share_one_copy_of_the_frames(dataset, monkeypatch) -> None:
    """On the CPU, which stands in for a GPU that has room."""
    held: list[Tensor] = []

    def on_device(frames: np.ndarray, device: torch.device) -> Tensor:
        held.append(torch.from_numpy(frames.copy()))
        return held[-1]

    phases = (Phase(name="video", fraction=0.5, earlier=2), Phase(name="named", fraction=0.5, needs_actions=True))
    expected = parts_of(phases, _data(dataset, "100%"), CONFIG, 0, CPU)
    monkeypatch.setattr("dmotion_bench.learning.data.batches._on_device", on_device)
    monkeypatch.setattr(FramesOnDevice, "_fits", lambda self, cache: True)
    parts = parts_of(phases, _data(dataset, "100%"), CONFIG, 0, CPU)
    assert len(held) == 1
    held[0].copy_(255 - held[0])  # so that frames of the cache would be found out
    for part, other in zip(parts, expected, strict=True):
        for ours, theirs in ((part.batches, other.batches), (part.validation, other.validation)):
            index = np.arange(len(ours))
            inverted, batch = ours(index), theirs(index)
            torch.testing.assert_close(inverted.current, -batch.current)
            if batch.earlier is not None:
                torch.testing.assert_close(inverted.earlier, -batch.earlier)


def test_batches_that_no_phase_uses_are_not_made(dataset, monkeypatch) -> None:
    asked: list[bool] = []
    of_sets = curriculum._of_sets
    monkeypatch.setattr(curriculum, "_of_sets", lambda *given: asked.append(given[2]) or of_sets(*given))
    parts_of((Phase(needs_actions=True),), _data(dataset, "100%"), CONFIG, 0, CPU)
    assert asked == [True]
