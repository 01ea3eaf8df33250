"""Two models of a few hundred weights that have all that a checkpoint can hold: phases, buffers, per-triplet losses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dmotion_bench.learning.action_to_latent import ActionToLatent
from dmotion_bench.learning.model import (
    Demonstrations,
    ForwardModel,
    Losses,
    ModelInputs,
    Phase,
    TrainingConfig,
    TripletBatch,
)
from dmotion_bench.specs import Preset, Supervision

TRAINING = TrainingConfig(
    epochs=1, batch_size=8, precision="float32", channels_last=False, ema=0.9, hard_share=0.5, validations=2
)


@dataclass(frozen=True, kw_only=True)
class SmallConfig:
    """``width`` channels, ``latents`` latent actions, some of them of ``scale``; ``sizes`` and ``mode`` are idle."""

    width: int = 4
    latents: int = 4
    scale: float = 1.0
    normal: bool = True
    mode: str = "plain"
    sizes: tuple[int, ...] = (1, 2)


class Small(ForwardModel[SmallConfig]):
    """Learns from video alone; which latent action an action is, is aligned."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = "nobody, nowhere"
    Config: ClassVar[type] = SmallConfig

    def __init__(self, config: SmallConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.see = nn.Conv2d(9, config.latents, 3, padding=1)
        self.move = nn.Conv2d(6 + config.latents, config.width, 3, padding=1)
        self.normal = nn.BatchNorm2d(config.width) if config.normal else nn.Identity()
        self.draw = nn.Conv2d(config.width, 3, 1)
        self.table = ActionToLatent(inputs.actions, config.latents)

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        return TRAINING

    def _latent(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        return self.see(torch.cat([previous, current, following], 1)).mean((2, 3))

    def _next(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        plane = latent[:, :, None, None].expand(-1, -1, *current.shape[2:])
        hidden = F.relu(self.normal(self.move(torch.cat([previous, current, plane], 1))))
        return torch.tanh(current + self.config.scale * self.draw(hidden))

    def losses(self, batch: TripletBatch) -> Losses:
        latent = self._latent(batch.previous, batch.current, batch.next)
        return _losses(self._next(batch.previous, batch.current, latent), batch.next)

    def align(self, demonstrations: Demonstrations) -> None:
        latent = self._latent(demonstrations.previous, demonstrations.current, demonstrations.next)
        self.table.fit(latent, demonstrations.action)

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return self._next(previous, current, self.table(action))


class SmallWorld(Small):
    """Learns in two phases, the second from actions."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS

    def phases(self) -> tuple[Phase, ...]:
        return Phase(name="watch", fraction=0.5), Phase(name="act", fraction=0.5, needs_actions=True)

    def losses(self, batch: TripletBatch) -> Losses:
        if batch.action is None:
            return super().losses(batch)
        return _losses(self.predict(batch.previous, batch.current, batch.action), batch.next)

    def align(self, demonstrations: Demonstrations) -> None:
        """There is nothing to align."""

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        known = self.table.encoding(action).to(current.dtype)
        return self._next(previous, current, F.pad(known, (0, self.config.latents - known.shape[1])))


def _losses(predicted: Tensor, truth: Tensor) -> Losses:
    each = F.mse_loss(predicted, truth, reduction="none").mean((1, 2, 3))
    return Losses(total=each.mean(), terms={"prediction": each.detach().mean()}, per_triplet=each.detach())
