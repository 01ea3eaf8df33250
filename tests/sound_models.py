"""Small models that keep the contract, for tests that break one part of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import nn

from dmotion_bench.learning.model import ForwardModel, Losses
from dmotion_bench.specs import Supervision


@dataclass(frozen=True, kw_only=True)
class SoundConfig:
    width: int = 4


class Sound(ForwardModel[SoundConfig]):
    """A supervised model of one convolution."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "Nobody: Nothing, 2026"
    Config: ClassVar[type] = SoundConfig

    def __init__(self, config, inputs) -> None:
        super().__init__(config, inputs)
        self.layer = nn.Conv2d(6 + len(inputs.actions), 3, 3, padding=1)

    def losses(self, batch):
        error = (self._next(batch.previous, batch.current, batch.action) - batch.next).square().mean((1, 2, 3))
        return Losses(total=error.mean(), terms={"error": error.mean().detach()}, per_triplet=error.detach())

    def predict(self, previous, current, action):
        return self._next(previous, current, action)

    def _next(self, previous, current, action):
        chosen = nn.functional.one_hot(action, len(self.inputs.actions)).float()[..., None, None]
        return self.layer(torch.cat([previous, current, chosen.expand(-1, -1, *current.shape[2:])], dim=1)).float()


class SoundVideo(Sound):
    """A model of video alone, aligned by a table."""

    supervision = Supervision.NONE

    def __init__(self, config, inputs) -> None:
        super().__init__(config, inputs)
        self.register_buffer("table", torch.zeros(len(inputs.actions), 3))
        self.code = nn.Linear(3, len(inputs.actions))

    def losses(self, batch):
        error = self._coded(batch.previous, batch.current, self._code(batch.current, batch.next)) - batch.next
        return Losses(total=error.square().mean())

    def align(self, demonstrations):
        for action, code in zip(
            demonstrations.action, self._code(demonstrations.current, demonstrations.next), strict=True
        ):
            self.table[action] = code

    def predict(self, previous, current, action):
        return self._coded(previous, current, self.table[action])

    def _code(self, current, following):
        return (following - current).mean((2, 3))

    def _coded(self, previous, current, code):
        tiled = self.code(code)[..., None, None].expand(-1, -1, *current.shape[2:])
        return self.layer(torch.cat([previous, current, tiled], dim=1)).float()


def breaks(base: type, **changes: Any) -> type:
    """A class that does something else than ``base``."""
    return type("Broken", (base,), changes)
