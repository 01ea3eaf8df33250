"""Muon against the published formulas, one parameter and one step after the other."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from dmotion_bench.learning.training.muon import FEW, ITERATIONS, NEWTON_SCHULZ, Muon, orthogonalised

RATE, MOMENTUM, SECOND = 0.01, 0.9, 0.95


def _newton_schulz(matrix: Tensor) -> Tensor:
    """Jordan et al. 2024, in the type of the matrix."""
    work = torch.div(matrix, torch.linalg.matrix_norm(matrix))
    a, b, c = NEWTON_SCHULZ
    for _ in range(ITERATIONS):
        square = work @ work.mT
        work = torch.add(a * work, (b * square + c * square @ square) @ work)
    return work


def _network() -> nn.Sequential:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(3, 8, 3), nn.ConvTranspose2d(8, 4, 2, 2), nn.Flatten(), nn.LazyLinear(5))
    network(torch.zeros(1, 3, 6, 6))
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _gradients(network: nn.Module, step: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(step)
    return {name: torch.randn(one.shape, generator=generator) for name, one in network.named_parameters()}


def _optimizer(network: nn.Module) -> Muon:
    named = dict(network.named_parameters())
    groups: list[dict[str, Any]] = [
        {"params": [one for one in named.values() if one.ndim > 1], "matrices": True},
        {"params": [one for one in named.values() if one.ndim == 1]},
    ]
    return Muon(groups, RATE, MOMENTUM, SECOND)


def _step(network: nn.Module, optimizer: Muon, step: int) -> None:
    for name, gradient in _gradients(network, step).items():
        parameter = network.get_parameter(name)
        parameter.grad = gradient.clone(memory_format=torch.preserve_format).to(
            memory_format=torch.channels_last if gradient.ndim == 4 else torch.preserve_format
        )
    optimizer.step()


def test_steps_are_those_of_the_papers_whatever_the_memory_format() -> None:
    network = _network()
    weights = {name: one.detach().double() for name, one in network.named_parameters()}
    means = {name: torch.zeros_like(one) for name, one in weights.items()}
    squares = {name: torch.zeros_like(one) for name, one in weights.items()}
    optimizer = _optimizer(network)
    for step in range(1, 4):
        _step(network, optimizer, step)
        for name, given in _gradients(network, step).items():
            gradient = given.double()
            means[name] = MOMENTUM * means[name] + (1 - MOMENTUM) * gradient
            if gradient.ndim > 1:  # Jordan et al. 2024; Liu et al. 2025, equation 4
                nesterov = MOMENTUM * means[name] + (1 - MOMENTUM) * gradient
                direction = _newton_schulz(nesterov.flatten(1)).view(gradient.shape)
                weights[name] -= RATE * 0.2 * max(nesterov.flatten(1).shape) ** 0.5 * direction
            else:  # Kingma and Ba 2015
                squares[name] = SECOND * squares[name] + (1 - SECOND) * gradient.square()
                unbiased = squares[name] / (1 - SECOND**step)
                weights[name] -= RATE * means[name] / (1 - MOMENTUM**step) / (unbiased.sqrt() + 1e-8)
    for name, weight in weights.items():
        torch.testing.assert_close(network.get_parameter(name).double(), weight, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("products", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("shape", [(2, 160, 224), (2, 224, 160)])
def test_large_matrices_are_orthogonalised_in_the_type_that_is_asked_for(
    products: torch.dtype, shape: tuple[int, ...]
) -> None:
    matrices = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    assert matrices.numel() > FEW
    found = orthogonalised(matrices, products)
    for one, matrix in zip(found, matrices, strict=True):
        exact = _newton_schulz(matrix.double())
        difference = float((one - exact).norm() / exact.norm())
        assert difference < (0.05 if products is torch.bfloat16 else 1e-4)
        assert (difference > 1e-3) == (products is torch.bfloat16)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(2, 64, 576), (2, 576, 64)])
def test_matrices_of_few_rows_or_columns_follow_the_formula_even_where_they_are_nearly_singular(
    shape: tuple[int, ...],
) -> None:
    left, _, right = torch.linalg.svd(torch.randn(shape, generator=torch.Generator().manual_seed(0)), False)
    for smallest in (1e-1, 1e-4, 0.0):
        values = torch.linspace(1, smallest, min(shape[1:])) ** 2
        matrices = left * values @ right
        for one, matrix in zip(orthogonalised(matrices), matrices, strict=True):
            exact = _newton_schulz(matrix.double())
            assert float((one - exact).norm() / exact.norm()) < 1e-4


def test_a_restored_optimizer_goes_on_as_if_it_had_not_stopped() -> None:
    network, other = _network(), _network()
    optimizer, restored = _optimizer(network), _optimizer(other)
    for step in (1, 2):
        _step(network, optimizer, step)
    other.load_state_dict(network.state_dict())
    kept: dict[str, Any] = copy.deepcopy(optimizer.state_dict())
    for state in kept["state"].values():  # a checkpoint keeps no memory format
        state.update({name: tensor.contiguous() for name, tensor in state.items()})
    restored.load_state_dict(kept)
    for one, which in ((network, optimizer), (other, restored)):
        _step(one, which, 3)
    for name, parameter in network.named_parameters():
        assert torch.equal(parameter, other.get_parameter(name))
