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
FEW = 2**16
"""So few numbers a CPU multiplies faster in float32: in bfloat16 the call itself takes longer than the product."""


SMALL = 2**13
"""Fewer numbers are iterated as they are: the calls take longer than their products."""


def orthogonalised(matrices: Tensor, products: torch.dtype = torch.bfloat16) -> Tensor:
    """Matrices with about the same singular vectors and all singular values near one: ``[n r c]`` to ``[n r c]``.

    Args:
        matrices: In float32.
        products: The type in which large matrices are multiplied that are nearly square or not on the CPU.
    """
    rows, columns = matrices.shape[-2:]
    work = matrices if rows <= columns else matrices.mT
    short, long = work.shape[-2:]
    on_cpu = matrices.device.type == "cpu"
    if on_cpu and long >= 2 * short and matrices.numel() >= SMALL:
        work = _by_gram_matrices(work)
    else:
        work = _newton_schulz(work, torch.float32 if on_cpu and matrices.numel() <= FEW else products)
    return work if rows <= columns else work.mT


def _newton_schulz(wide: Tensor, products: torch.dtype) -> Tensor:
    """The iteration as it is written in the paper."""
    work = (wide / (wide.norm(dim=(-2, -1), keepdim=True) + 1e-12)).to(products)
    first, third, fifth = NEWTON_SCHULZ
    for _ in range(ITERATIONS):
        square = work @ work.mT
        work = torch.baddbmm(work, torch.baddbmm(square, square, square, beta=third, alpha=fifth), work, beta=first)
    found: Tensor = work.float()
    return found


def _by_gram_matrices(wide: Tensor) -> Tensor:
    """The same for X of few rows: every iterate is P X, and P follows from G = X X^T alone.

    X takes part in two products instead of ten. G needs float32: an eigenvalue that rounding makes negative grows with
    every iteration.
    """
    gram = wide @ wide.mT
    size = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].sqrt() + 1e-12  # the norm of X
    gram = gram / size.square()
    first, third, fifth = NEWTON_SCHULZ
    polynomial = None
    for iteration in range(ITERATIONS):
        factor = torch.baddbmm(gram, gram, gram, beta=third, alpha=fifth)
        factor.diagonal(dim1=-2, dim2=-1).add_(first)
        polynomial = factor if polynomial is None else factor @ polynomial
        if iteration + 1 < ITERATIONS:
            gram = factor @ gram @ factor
    assert polynomial is not None, "there is at least one iteration"
    found: Tensor = (polynomial / size) @ wide
    return found


class _Recorded:
    """``orthogonalised`` for matrices of given shapes on a GPU, as a CUDA graph.

    The iteration is some 20 small products for each shape, 30 to 53% of all calls of a training step
    (docs/experiments/speed.md). To tell a GPU of each takes a processor longer than the GPU needs for it; a graph is
    told at once.

    Args:
        like: Matrices of the shapes.
        products: See ``orthogonalised``.
    """

    def __init__(self, like: list[Tensor], products: torch.dtype) -> None:
        self._given = [matrices.clone() for matrices in like]
        # what is called for the first time may not be recorded
        beside = torch.cuda.Stream(like[0].device)  # type: ignore[no-untyped-call]
        beside.wait_stream(torch.cuda.current_stream(like[0].device))
        with torch.cuda.stream(beside):
            for matrices in self._given:
                orthogonalised(matrices, products)
        torch.cuda.current_stream(like[0].device).wait_stream(beside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):  # NCCL's own thread goes on meanwhile
            self._found = [orthogonalised(matrices, products) for matrices in self._given]

    def __call__(self, together: list[Tensor]) -> list[Tensor]:
        """The same of these matrices; what is returned holds until the next call."""
        torch._foreach_copy_(self._given, together)
        self._graph.replay()
        return self._found


class Muon(torch.optim.Optimizer):
    """Muon for the groups marked ``matrices=True``, Adam for the others.

    Args:
        groups: Parameter groups; each may set ``lr``, ``matrices`` and ``weight_decay``.
        lr: Learning rate of both halves.
        momentum: Of Muon's running mean, and Adam's first beta.
        second: Adam's second beta.
        products: The type in which Muon multiplies large matrices; bfloat16 is slow on hardware that emulates it.
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        lr: float,
        momentum: float = 0.9,
        second: float = 0.95,
        products: torch.dtype = torch.bfloat16,
    ) -> None:
        defaults = {"lr": lr, "momentum": momentum, "second": second, "matrices": False, "weight_decay": 0.0}
        super().__init__(list(groups), defaults)
        self.products = products
        self._recorded: dict[tuple[torch.Size, ...], _Recorded] = {}

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

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state; counts stay on the CPU, where reading them waits for nothing."""
        super().load_state_dict(state_dict)  # brings all to where the parameters are
        for own, given in zip(self.param_groups, state_dict["param_groups"], strict=True):
            for parameter, number in zip(own["params"], given["params"], strict=True):
                if "count" in (state := state_dict["state"].get(number, {})):
                    self.state[parameter]["count"] = state["count"].cpu().clone()

    def _state(self, parameter: Tensor, name: str) -> Tensor:
        state: dict[str, Tensor] = self.state[parameter]
        if name not in state:
            state[name] = torch.zeros_like(parameter, dtype=torch.float32)
        return state[name]

    def _count(self, parameter: Tensor) -> Tensor:
        """How many steps were taken, on the CPU."""
        state: dict[str, Tensor] = self.state[parameter]
        if "count" not in state:
            state["count"] = torch.zeros(())
        return state["count"]

    def _step_matrices(
        self, group: dict[str, Any], parameters: list[Tensor], gradients: list[Tensor], means: list[Tensor]
    ) -> None:
        nesterov = torch._foreach_lerp(gradients, means, group["momentum"])
        by_shape: dict[tuple[int, int], list[int]] = {}
        for place, parameter in enumerate(parameters):
            by_shape.setdefault((len(parameter), parameter.numel() // len(parameter)), []).append(place)
        together = [
            torch.stack([_matrix(nesterov[place], parameters[place]) for place in places])
            for places in by_shape.values()
        ]
        found = self._orthogonalised(together)
        for ((rows, columns), places), matrices in zip(by_shape.items(), found, strict=True):
            changed = [parameters[place] for place in places]
            steps = [_weight(matrix, parameter) for matrix, parameter in zip(matrices, changed, strict=True)]
            torch._foreach_add_(changed, steps, alpha=-group["lr"] * 0.2 * max(rows, columns) ** 0.5)

    def _orthogonalised(self, together: list[Tensor]) -> list[Tensor]:
        """Matrices of several shapes; on a GPU all of them by one call."""
        if together[0].device.type != "cuda":
            return [orthogonalised(matrices, self.products) for matrices in together]
        shapes = tuple(matrices.shape for matrices in together)
        if shapes not in self._recorded:
            self._recorded[shapes] = _Recorded(together, self.products)
        return self._recorded[shapes](together)

    def _step_adam(
        self, group: dict[str, Any], parameters: list[Tensor], gradients: list[Tensor], means: list[Tensor]
    ) -> None:
        squares = [self._state(parameter, "square") for parameter in parameters]
        torch._foreach_mul_(squares, group["second"])
        torch._foreach_addcmul_(squares, gradients, gradients, 1 - group["second"])
        counts = [self._count(parameter) for parameter in parameters]
        torch._foreach_add_(counts, 1)
        numbers = [float(count) for count in counts]
        scales = torch._foreach_div(squares, [1 - group["second"] ** number for number in numbers])
        torch._foreach_sqrt_(scales)
        torch._foreach_add_(scales, 1e-8)
        sizes = [-group["lr"] / (1 - group["momentum"] ** number) for number in numbers]
        torch._foreach_addcdiv_(parameters, means, scales, sizes)


def _matrix(values: Tensor, weight: Tensor) -> Tensor:
    """Values of a weight as a matrix of outputs by everything else.

    The columns follow each other as in the weight's memory: what lies there likewise is not copied. Their order does
    not matter to the matrix's singular values.
    """
    return (values.permute(0, 2, 3, 1) if _is_channels_last(weight) else values).flatten(1)


def _weight(matrix: Tensor, weight: Tensor) -> Tensor:
    """The inverse of ``_matrix``."""
    if not _is_channels_last(weight):
        return matrix.view(weight.shape)
    outputs, inputs, height, width = weight.shape
    return matrix.view(outputs, height, width, inputs).permute(0, 3, 1, 2)


def _is_channels_last(weight: Tensor) -> bool:
    return weight.ndim == 4 and weight.is_contiguous(memory_format=torch.channels_last)
