"""Phases follow each other; each has its own share of the triplets, and batches of its own size if it wants."""

from __future__ import annotations

import torch

from dmotion_bench.learning.curriculum import TrainingData, parts_of
from dmotion_bench.learning.labels import LabelBudget, LabelRequest
from dmotion_bench.learning.model import Phase, TrainingConfig
from dmotion_bench.learning.triplets import TripletSet


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
