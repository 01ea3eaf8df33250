"""Sharing prefixes changes how much is predicted, never what."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.worlds import PerfectGridModel, Walks, observed, unseen

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import PlannerContractBroken
from dmotion_bench.learning.model import ForwardModel, ModelInputs
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.objectives.pixel import PixelEvaluator
from dmotion_bench.planning.solvers.exhaustive import all_sequences
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree


def tree_of(walks: Walks, horizon: int) -> PrefixTree:
    return PrefixTree(walks, walks.evaluator, unseen(walks.tasks), horizon)


def one_by_one(walks: Walks, sequences: np.ndarray) -> np.ndarray:
    """The costs of sequences predicted one at a time, step by step, with nothing shared."""
    costs = np.empty(sequences.shape)
    for task in range(sequences.shape[0]):
        for place in range(sequences.shape[1]):
            state = tuple(part[task : task + 1] for part in walks.start(unseen(walks.tasks)))
            for step, action in enumerate(sequences[task, place].tolist()):
                chosen = torch.tensor([action])
                state = walks.step(state, chosen)
                cost, _ = walks.evaluator.step(walks, state, torch.tensor([task]), chosen, ())
                costs[task, place, step] = cost.stacked()[0, 0].item()
    return costs


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=30)
@given(data=st.data())
def test_the_costs_are_those_of_naive_evaluation(data: st.DataObject) -> None:
    tasks, count, steps = (data.draw(st.integers(1, most)) for most in (3, 12, 6))
    generator = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    tree = tree_of(Walks(tuple(range(tasks))), steps)
    for _ in range(3):  # later rounds find some of their prefixes in the tree
        sequences = generator.integers(0, 4, (tasks, count, steps))
        np.testing.assert_array_equal(tree.costs(sequences), one_by_one(Walks(tuple(range(tasks))), sequences))


@pytest.mark.parametrize("action", [-1, 4])
def test_an_action_that_there_is_not_is_refused(action: int) -> None:
    with pytest.raises(PlannerContractBroken, match=f"tries the actions .*{action}.*; there are 0 to 3"):
        tree_of(Walks((0,)), 2).costs(np.array([[[0, action]]]))


@pytest.mark.parametrize(
    ("sequences", "found"),
    [
        (np.zeros((2, 3, 4), np.int64), r"int64 of the shape \(2, 3, 4\)"),  # of more tasks
        (np.zeros((1, 3), np.int64), r"int64 of the shape \(1, 3\)"),
        (np.zeros((1, 0, 4), np.int64), r"int64 of the shape \(1, 0, 4\)"),
        (np.zeros((1, 3, 4)), r"float64 of the shape \(1, 3, 4\)"),
        ([[[0, 1]]], "a list"),
    ],
)
def test_what_is_no_array_of_sequences_is_refused(sequences: Any, found: str) -> None:
    wanted = r"as its sequences; they must be a NumPy array of the shape \(1, sequences, steps\), of whole numbers"
    with pytest.raises(PlannerContractBroken, match=f"the solver tries {found} {wanted}"):
        tree_of(Walks((0,)), 4).stacked_costs(sequences)


def test_every_prefix_is_predicted_once() -> None:
    walks = Walks((0, 1))
    tree = tree_of(walks, 5)
    everything = np.broadcast_to(all_sequences(4, 5), (2, 1024, 5))
    tree.costs(everything[:, ::3])
    tree.costs(everything)
    tree.costs(everything[:, ::-1])
    assert tree.frames == len(walks.expanded) == len(set(walks.expanded)) == 2 * (4 + 16 + 64 + 256 + 1024)


def test_fifty_random_sequences_share_most_of_their_beginnings() -> None:
    sequences = np.random.default_rng(0).integers(0, 4, (1, 50, 5))
    tree = tree_of(Walks((0,)), 5)
    tree.costs(sequences)
    assert tree.frames == sum(len({row[:depth].tobytes() for row in sequences[0]}) for depth in range(1, 6)) < 190


def test_sequences_longer_than_the_tree_are_refused() -> None:
    with pytest.raises(ValueError, match="6 actions in a tree made for 5"):
        tree_of(Walks((0,)), 5).costs(np.zeros((1, 1, 6), np.int64))


class TwoImages(PerfectGridModel):
    """A model of which the default ``begin``, ``advance`` and ``frame`` are used, and whose last frame matters."""

    def predict(self, previous: torch.Tensor, current: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        self.frames += len(action)
        return (0.5 * previous - 0.7 * current + 0.1 * action[:, None, None, None]).tanh()


def test_a_models_tree_is_its_rollout() -> None:
    generator = np.random.default_rng(3)
    images = torch.from_numpy(generator.integers(0, 256, (3, 2, 8, 8, 3), dtype=np.uint8))
    goals, model = images.flip(0)[:, 0], TwoImages()
    model.inputs = ModelInputs(height=8, width=8, actions=Discrete.numbered(4))
    dynamics, seen = ModelDynamics(model, bf16=False, at_once=16), observed(images[:, 1], previous=images[:, 0])
    sequences = generator.integers(0, 4, (2, 3, 20, 4))
    tree = PrefixTree(dynamics, PixelEvaluator(goals.numpy()), seen, 4)
    tree.costs(sequences[0])
    found = tree.costs(sequences[1])
    assert tree.frames == model.frames < 2 * 3 * 20 * 4

    as_seen = images.float().mul(2 / 255).sub(1).movedim(-1, -3)
    for task in range(3):
        start = as_seen[task].unsqueeze(1).expand(2, 20, 3, 8, 8)
        frames = ForwardModel.rollout(model, start[0], start[1], torch.from_numpy(sequences[1, task]))
        wanted = (frames - as_seen.flip(0)[task, 0]).square().flatten(2).mean(2)
        np.testing.assert_allclose(found[task], wanted, rtol=1e-5)
