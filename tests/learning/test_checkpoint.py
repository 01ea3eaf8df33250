"""Checkpoints: round trips, damage, and nothing that unpickles."""

from __future__ import annotations

import os
import pickle

import pytest
import torch

from dmotion_bench.errors import RunCorrupt, RunMissing
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.training.optimizer import AveragedWeights
from dmotion_bench.learning.training.samples import samples_of


def test_tensors_and_facts_survive(tmp_path) -> None:
    tensors = {"model/a": torch.randn(3, 4).T, "model/b": torch.arange(5), "average/a": torch.ones(2).bfloat16()}
    checkpoint.save(tmp_path / "x.safetensors", tensors, {"step": 3, "best": 0.1})
    loaded, facts = checkpoint.load(tmp_path / "x.safetensors")
    assert facts == {"step": 3, "best": 0.1}
    assert loaded.keys() == tensors.keys()
    for name, tensor in tensors.items():
        torch.testing.assert_close(loaded[name], tensor, rtol=0, atol=0)


def test_an_optimiser_goes_on_as_if_nothing_had_happened(tmp_path) -> None:
    def build() -> tuple[torch.nn.Linear, torch.optim.Optimizer]:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            model = torch.nn.Linear(4, 3)
        return model, torch.optim.AdamW(model.parameters(), lr=0.1)

    def steps(model: torch.nn.Linear, optimizer: torch.optim.Optimizer, start: int, stop: int) -> None:
        for step in range(start, stop):
            optimizer.zero_grad()
            model(torch.full((2, 4), step + 1.0)).square().sum().backward()
            optimizer.step()

    whole, whole_optimizer = build()
    steps(whole, whole_optimizer, 0, 6)
    first, first_optimizer = build()
    steps(first, first_optimizer, 0, 3)
    tensors = checkpoint.with_prefix("model", first.state_dict()) | checkpoint.optimizer_tensors(first_optimizer)
    checkpoint.save(tmp_path / "x.safetensors", tensors, {})
    second, second_optimizer = build()
    loaded, _ = checkpoint.load(tmp_path / "x.safetensors")
    second.load_state_dict(checkpoint.without_prefix("model", loaded))
    checkpoint.restore_optimizer(second_optimizer, loaded)
    steps(second, second_optimizer, 3, 6)
    assert all((a == b).all() for a, b in zip(whole.parameters(), second.parameters(), strict=True))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_not_waited_for(tmp_path) -> None:
    """The folder of a run may come from anybody."""
    os.mkfifo(path := tmp_path / "x.safetensors")
    for read in (checkpoint.load, checkpoint.count_tensors):
        with pytest.raises(RunCorrupt, match="is no ordinary file"):
            read(path)
    os.mkfifo(tmp_path / "00000001.png")
    (tmp_path / "samples").symlink_to(tmp_path)
    assert samples_of(tmp_path) == {}


def test_damage_is_said_in_a_sentence(tmp_path) -> None:
    path = tmp_path / "x.safetensors"
    with pytest.raises(RunMissing, match="not been trained"):
        checkpoint.load(path)
    checkpoint.save(path, {"model/a": torch.ones(100)}, {})
    whole = path.read_bytes()
    for damaged in (whole[:50], whole[:-10], b"", b"\xff" * 100, pickle.dumps({"a": 1})):
        path.write_bytes(damaged)
        with pytest.raises(RunCorrupt, match="cannot be read"):
            checkpoint.load(path)


def test_the_hash_sees_every_bit_and_no_layout() -> None:
    weights = {"a": torch.randn(2, 3, 4, 4, generator=torch.Generator().manual_seed(0)), "b": torch.zeros(1)}
    same = {"b": torch.zeros(1), "a": weights["a"].to(memory_format=torch.channels_last)}
    assert checkpoint.weights_hash(weights) == checkpoint.weights_hash(same)
    other = {**weights, "b": torch.tensor([-0.0])}
    assert checkpoint.weights_hash(weights) != checkpoint.weights_hash(other)


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_read_again(tmp_path, monkeypatch) -> None:
    """As a training that goes on does; safetensors opens the file once for its header and once for its tensors."""
    path, header = tmp_path / "last.safetensors", checkpoint._header
    checkpoint.save(path, {"a": torch.zeros(3)}, {"step": 1})

    def replaced(opened: object) -> object:
        monkeypatch.setattr(checkpoint, "_header", header)
        checkpoint.save(path, {"a": torch.ones(4)}, {"step": 2})
        raise ValueError("the header does not fit the file")

    monkeypatch.setattr(checkpoint, "_header", replaced)
    tensors, facts = checkpoint.load(path)
    assert (tensors["a"].tolist(), facts) == ([1.0] * 4, {"step": 2})


def test_tied_weights_survive_and_stay_tied(tmp_path) -> None:
    def tied() -> torch.nn.ModuleDict:
        layer = torch.nn.Linear(3, 2)
        return torch.nn.ModuleDict({"a": layer, "b": layer, "own": torch.nn.Linear(3, 2)})

    model, other = tied(), tied()
    part = model["a"].weight.detach()[1]  # shares a part of the memory
    checkpoint.save(tmp_path / "x.safetensors", {**model.state_dict(), "part": part}, {"step": 1})
    loaded, _ = checkpoint.load(tmp_path / "x.safetensors")
    assert torch.equal(loaded.pop("part"), part)
    other.load_state_dict(loaded)
    assert other["a"].weight is other["b"].weight
    assert checkpoint.weights_hash(other.state_dict()) == checkpoint.weights_hash(model.state_dict())


def test_tied_weights_are_averaged_by_every_name() -> None:
    layer = torch.nn.Linear(3, 2)
    model = torch.nn.ModuleDict({"a": layer, "b": layer})
    average = AveragedWeights(model, decay=0.9)
    with torch.no_grad():
        layer.weight.add_(1)
    latest = layer.weight.detach().clone()
    average.update(model, step=100)
    assert torch.equal(average.tensors["a.weight"], average.tensors["b.weight"])
    with average.swapped_into(model):
        assert not torch.equal(layer.weight, latest)
