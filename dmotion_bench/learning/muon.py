"""Muon: orthogonalised momentum for hidden weights, Adam for everything else, in one optimiser.

Jordan et al. 2024, *Muon: an optimizer for hidden layers in neural networks*; the step is scaled to the size of
Adam's as in Liu et al. 2025, *Muon is scalable for LLM training* (eq. 4), so one learning rate serves both halves.
Convolution kernels are matrices of outputs by everything else. Weights of one shape are orthogonalised as a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)  # the quintic's coefficients, Jordan et al.
ITERATIONS = 5


def orthogonalised(matrices: Tensor) -> Tensor:
    """Matrices with about the same singular vectors and all singular values near one: ``[n r c]`` to ``[n r c]``."""
    wide = matrices.shape[-2] <= matrices.shape[-1]
    work = matrices if wide else matrices.mT
    work = (work / (work.norm(dim=(-2, -1), keepdim=True) + 1e-12)).bfloat16()
    first, third, fifth = NEWTON_SCHULZ
    for _ in range(ITERATIONS):
        square = work @ work.mT
        work = torch.baddbmm(work, torch.baddbmm(square, square, square, beta=third, alpha=fifth), work, beta=first)
    return (work if wide else work.mT).float()


class Muon(torch.optim.Optimizer):
    """Muon for the groups marked ``matrices=True``, Adam for the others.

    Args:
        groups: Parameter groups; each may set ``lr``, ``matrices`` and ``weight_decay``.
        lr: Learning rate of both halves.
        momentum: Of Muon's running mean, and Adam's first beta.
        second: Adam's second beta.
    """

    def __init__(
        self, groups: Iterable[dict[str, Any]], lr: float, momentum: float = 0.9, second: float = 0.95
    ) -> None:
        defaults = {"lr": lr, "momentum": momentum, "second": second, "matrices": False, "weight_decay": 0.0}
        super().__init__(list(groups), defaults)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step with the gradients that are there."""
        loss = None if closure is None else torch.enable_grad()(closure)()
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if not parameters:
                continue
            if group["weight_decay"]:
                torch._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            gradients = [parameter.grad.float() for parameter in parameters]
            means = [self._state(parameter, "mean") for parameter in parameters]
            torch._foreach_lerp_(means, gradients, 1 - group["momentum"])
            if group["matrices"]:
                self._step_matrices(group, parameters, gradients, means)
            else:
                self._step_adam(group, parameters, gradients, means)
        return loss

    def _state(self, parameter: Tensor, name: str) -> Tensor:
        state: dict[str, Tensor] = self.state[parameter]
        if name not in state:
            state[name] = torch.zeros_like(parameter, dtype=torch.float32)
        return state[name]

    def _step_matrices(
        self, group: dict[str, Any], parameters: list[Tensor], gradients: list[Tensor], means: list[Tensor]
    ) -> None:
        by_shape: dict[tuple[int, int], list[int]] = {}
        for place, parameter in enumerate(parameters):
            by_shape.setdefault((len(parameter), parameter.numel() // len(parameter)), []).append(place)
        for (rows, columns), places in by_shape.items():
            nesterov = [torch.lerp(gradients[i], means[i], group["momentum"]).flatten(1) for i in places]
            steps = orthogonalised(torch.stack(nesterov))
            for i, step in zip(places, steps, strict=True):
                scale = 0.2 * max(rows, columns) ** 0.5
                parameters[i].add_(step.reshape(parameters[i].shape), alpha=-group["lr"] * scale)

    def _step_adam(
        self, group: dict[str, Any], parameters: list[Tensor], gradients: list[Tensor], means: list[Tensor]
    ) -> None:
        squares = [self._state(parameter, "square") for parameter in parameters]
        torch._foreach_mul_(squares, group["second"])
        torch._foreach_addcmul_(squares, gradients, gradients, 1 - group["second"])
        for parameter, mean, square in zip(parameters, means, squares, strict=True):
            count = self.state[parameter].setdefault("count", torch.zeros((), dtype=torch.float32))
            count += 1
            unbiased = float(1 - group["momentum"] ** float(count)), float(1 - group["second"] ** float(count))
            scale = (square / unbiased[1]).sqrt_().add_(1e-8)
            parameter.addcdiv_(mean, scale, value=-group["lr"] / unbiased[0])
