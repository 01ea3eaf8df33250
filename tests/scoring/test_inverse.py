"""The figures of an inverse model: how often it is right, or how far off."""

from __future__ import annotations

import pytest
import torch

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.scoring.inverse import inverse_figures
from dmotion_bench.scoring.samples import FIGURE_COLUMNS

MOVES = Continuous(names=("dx", "dy"), low=(-4.0, 0.0), high=(4.0, 2.0), units=("px", "px"))


def test_a_named_action_is_right_or_not() -> None:
    found = inverse_figures(torch.tensor([0, 2, 1]), torch.tensor([0, 1, 1]), Discrete.numbered(3))
    assert {name: values.tolist() for name, values in found.items()} == {"inverse_accuracy": [1, 0, 1]}


def test_named_numbers_are_compared_in_units_of_their_bounds() -> None:
    named, true = torch.tensor([[0.0, 1.0], [4.0, 0.0]]), torch.tensor([[0.0, 1.0], [-4.0, 1.0]])
    found = inverse_figures(named, true, MOVES)
    assert found["inverse_error"].tolist() == pytest.approx([0, (2**2 + 1**2) / 2])
    assert set(found) <= set(FIGURE_COLUMNS)


def test_names_that_are_not_one_for_each_triplet_are_refused() -> None:
    with pytest.raises(ModelContractBroken, match=r"shape \(3, 1\); the contract asks for \(3,\)"):
        inverse_figures(torch.zeros(3, 1), torch.tensor([0, 1, 1]), Discrete.numbered(3))


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_that_are_none_are_refused_and_not_left_out_of_the_mean(number: float) -> None:
    with pytest.raises(ModelContractBroken, match="infer_action gave actions that hold NaN or infinity"):
        inverse_figures(torch.tensor([[0.0, 1.0], [number, 0.0]]), torch.zeros(2, 2), MOVES)
