"""The optimiser, the learning rate's schedule, and the averaged weights."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.learning.model import ForwardModel, TrainingConfig
from dmotion_bench.learning.training.muon import Muon

WARM_UP = 0.1  # share of a one-cycle schedule in which the rate rises


def learning_rate(config: TrainingConfig, progress: float) -> float:
    """The rate at a share ``progress`` in [0, 1] of a phase."""
    if config.schedule == "constant":
        return config.learning_rate
    warm = 0.0 if config.schedule == "cosine" else WARM_UP
    if progress < warm:
        return config.learning_rate * (0.04 + 0.96 * progress / warm)
    if config.schedule == "linear":
        return config.learning_rate * max(1e-3, (1 - progress) / (1 - warm))
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * (progress - warm) / (1 - warm)))


def has_own_optimizer(model: ForwardModel[Any]) -> bool:
    """Whether a model's class may bring an optimiser of its own."""
    return type(model).make_optimizer is not ForwardModel.make_optimizer


def optimizer_of(model: ForwardModel[Any], config: TrainingConfig) -> torch.optim.Optimizer:
    """The optimiser that a model brings, or the one that its settings name.

    Raises:
        ModelContractBroken: The model's own is none, or trains none of its parameters or others than these.
    """
    own = model.make_optimizer(config)
    if own is None:
        return named_optimizer(model, config)
    if not isinstance(own, torch.optim.Optimizer):
        raise _broken(model, f"gives {type(own).__qualname__}; it gives a torch.optim.Optimizer or None")
    if "lr" not in own.defaults:
        raise _broken(model, f"gives {type(own).__qualname__}, whose groups have no 'lr' that a schedule could set")
    its = {id(parameter) for parameter in model.parameters()}
    trained = {id(parameter) for group in own.param_groups for parameter in group["params"]}
    if not trained or not trained <= its:
        which = "other parameters than the model's" if trained else "no parameter"
        raise _broken(model, f"gives an optimiser of {which}")
    for group in own.param_groups:
        group["rate_factor"] = float(group["lr"]) / config.learning_rate
    return own


def _broken(model: ForwardModel[Any], sentence: str) -> ModelContractBroken:
    return ModelContractBroken(f"{type(model).__qualname__}: make_optimizer(config) {sentence}.")


def named_optimizer(model: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """Adam, AdamW or Muon.

    A parameter may carry ``rate_factor``, the multiple of the rate that it learns at, and ``is_output``, which says
    that its layer is no hidden one: Muon leaves those, biases and gains to Adam. Biases and gains are not decayed.
    """
    groups: dict[tuple[float, bool, bool], list[nn.Parameter]] = {}
    for parameter in model.parameters():
        matrix = parameter.ndim > 1
        hidden = matrix and not getattr(parameter, "is_output", False)
        groups.setdefault((getattr(parameter, "rate_factor", 1.0), matrix, hidden), []).append(parameter)
    described = [
        {
            "params": parameters,
            "rate_factor": factor,
            "weight_decay": config.weight_decay if matrix else 0.0,
            **({"matrices": hidden} if config.optimizer == "muon" else {}),
        }
        for (factor, matrix, hidden), parameters in groups.items()
    ]
    if config.optimizer == "muon":
        products = torch.bfloat16 if has_bf16(next(model.parameters()).device) else torch.float32
        return Muon(described, lr=config.learning_rate, products=products)
    kind = torch.optim.AdamW if config.optimizer == "adamw" else torch.optim.Adam
    return kind(described, lr=config.learning_rate, fused=True)


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Give every group its multiple of the rate."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group["rate_factor"]


class AveragedWeights:
    """An exponential moving average of a model's parameters; buffers are taken as they are.

    The average is warmed up: after n steps its decay is at most (1 + n) / (10 + n).
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self.tensors = {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}

    @torch.no_grad()
    def update(self, model: nn.Module, step: int) -> None:
        """Update the average with the weights after a step."""
        decay = min(self.decay, (1 + step) / (10 + step))
        averaged: list[Tensor] = []
        latest: list[Tensor] = []
        parameters = {name for name, _ in model.named_parameters(remove_duplicate=False)}  # tied ones by every name
        for name, tensor in model.state_dict().items():
            if name in parameters:
                averaged.append(self.tensors[name])
                latest.append(tensor)
            else:
                self.tensors[name].copy_(tensor)
        torch._foreach_lerp_(averaged, latest, 1 - decay)

    @contextlib.contextmanager
    def swapped_into(self, model: nn.Module) -> Iterator[None]:
        """Give the model its averaged weights within the block."""
        own = {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}
        model.load_state_dict(self.tensors)
        try:
            yield
        finally:
            model.load_state_dict(own)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore an average from a checkpoint."""
        for name, tensor in tensors.items():
            self.tensors[name].copy_(tensor)
