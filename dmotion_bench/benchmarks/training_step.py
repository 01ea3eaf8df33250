"""A model's training step on made-up frames, to be timed: the model, its optimiser and a batch, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.hardware.precision import Precision, autocast, settled
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel, ModelInputs, TrainingConfig, TripletBatch
from dmotion_bench.learning.training.optimizer import optimizer_of
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Preset, Supervision

SIZE: Final = 128  # [px]
ACTIONS: Final = 4


class TrainingStep:
    """Called, it trains one step.

    Args:
        name, arch: Of the model.
        device: Where it trains; None for the CPU.
        changes: What differs from how the model is trained at preset small, by the fields of ``TrainingConfig``.

    Attributes:
        config: How it is trained.
        precision: Its own, or where it asks for ``"auto"``, bf16 where the hardware has it.
    """

    def __init__(self, name: str, arch: str, *, device: torch.device | None = None, **changes: Any) -> None:
        kind, self._device = model_class(name), device or torch.device("cpu")
        self.config: TrainingConfig = replace(kind.training_defaults(Preset.SMALL, arch), **changes)
        self.precision: Precision = settled(self.config.precision, 0, self._device) or "bf16"
        self._model = untrained(name, arch).to(self._device).laid_out(channels_last=self.config.channels_last)
        self._optimizer = optimizer_of(self._model, self.config)
        self._model.enter(max(self._model.phases(), key=lambda phase: phase.fraction))
        self._model.train()
        self._batch = _noise(self.config.batch_size, kind.supervision is Supervision.ACTIONS, self._device)

    def __call__(self) -> None:
        """One step: loss, gradient, update."""
        with autocast(self.precision, self._device):
            losses = self._model.losses(self._batch)
        torch.autograd.backward(losses.total)
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)

    def operations(self) -> float:
        """Floating-point operations of a triplet, in matrix products and convolutions; a step is taken to count."""
        with FlopCounterMode(display=False) as counter:
            self()
        return float(counter.get_total_flops() / self.config.batch_size)


def untrained(name: str, arch: str) -> ForwardModel[Any]:
    """A model with its first weights, the same each time."""
    kind = model_class(name)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return kind(kind.configure(arch), ModelInputs(height=SIZE, width=SIZE, actions=Discrete.numbered(ACTIONS)))


def _noise(size: int, labelled: bool, device: torch.device) -> TripletBatch:
    frames = np.random.default_rng(0).integers(0, 256, (size, 3, SIZE, SIZE, 3), dtype=np.uint8)
    images = to_model(torch.from_numpy(frames).to(device))
    previous, current, following = (images[:, step].contiguous(memory_format=torch.channels_last) for step in range(3))
    action = torch.arange(size, device=device) % ACTIONS if labelled else None
    episode = torch.arange(size, device=device) // 4
    return TripletBatch(previous=previous, current=current, next=following, action=action, episode=episode)
