"""A model and its optimiser on Fabric's device; several processes average the gradients of its losses (DDP)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from dmotion_bench.learning.model import ForwardModel, Losses, TripletBatch

if TYPE_CHECKING:
    from lightning_fabric import Fabric


class _PlainLosses(nn.Module):
    """A model whose losses are tuples: Fabric and DDP look for tensors in these, and not in frozen dataclasses."""

    def __init__(self, model: ForwardModel[Any]) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: TripletBatch) -> tuple[Tensor, Mapping[str, Tensor], Tensor | None]:
        losses = self.model.losses(batch)
        return losses.total, losses.terms, losses.per_triplet


def set_up(
    fabric: Fabric, model: ForwardModel[Any], optimizer: torch.optim.Optimizer
) -> tuple[Callable[[TripletBatch], Losses], torch.optim.Optimizer]:
    """The losses of a model on Fabric's device, their gradients averaged over all processes, and its optimiser."""
    if fabric.world_size == 1:
        alone, prepared = fabric.setup(model, optimizer)
        alone.mark_forward_method("losses")
        return alone.losses, prepared
    shared, prepared = fabric.setup(_PlainLosses(model), optimizer)

    def losses(batch: TripletBatch) -> Losses:
        total, terms, per_triplet = shared(batch)
        return Losses(total=total, terms=terms, per_triplet=per_triplet)

    return losses, prepared
