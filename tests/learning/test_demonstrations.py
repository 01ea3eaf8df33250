"""Demonstrations that are made from the stored frames are those in memory, and models read the same off both."""

from __future__ import annotations

import pytest
import torch

from dmotion_bench.learning import demonstrations as module
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.stored_demonstrations import StoredDemonstrations, in_memory, shown_to_models
from dmotion_bench.learning.data.triplets import TripletSet

CPU = torch.device("cpu")


@pytest.fixture
def given(dataset):
    triplets = TripletSet.of_split(dataset, "train")
    return LabelBudget(dataset, LabelRequest.parse("all"), seed=1).demonstrations(triplets)


def test_many_demonstrations_are_the_same_as_in_memory(given, monkeypatch) -> None:
    whole, stored = in_memory(given, CPU), StoredDemonstrations(given, CPU)
    monkeypatch.setattr(module, "READ_AT_ONCE", 5)
    assert len(whole) == len(stored) == len(given.rows) > 5
    for name in ("previous", "current", "next", "action"):
        assert torch.equal(getattr(whole, name), getattr(stored, name))
    index = torch.tensor([7, 0, 7])
    for name in ("previous", "current", "next", "action"):
        assert torch.equal(getattr(whole.subset(index), name), getattr(stored.subset(index), name))

    def difference(previous, current, following):
        assert len(previous) <= 5
        return (following - current - previous).mean((2, 3))

    read = stored.read(difference)
    assert torch.equal(read, whole.read(difference))
    torch.testing.assert_close(read, (whole.next - whole.current - whole.previous).mean((2, 3)))


def test_images_are_contiguous_where_a_model_asks_for_it(given) -> None:
    for made in (in_memory(given, CPU), StoredDemonstrations(given, CPU)):
        assert not made.current.is_contiguous()
        laid_out = made.contiguous()
        assert laid_out.current.is_contiguous()
        assert laid_out.subset(torch.tensor([1])).next.is_contiguous()
        assert torch.equal(laid_out.current, made.current)


def test_few_are_in_memory(given, monkeypatch) -> None:
    assert not isinstance(shown_to_models(given, CPU), StoredDemonstrations)
    monkeypatch.setattr("dmotion_bench.learning.data.stored_demonstrations.READ_AT_ONCE", 5)
    assert isinstance(shown_to_models(given, CPU), StoredDemonstrations)
