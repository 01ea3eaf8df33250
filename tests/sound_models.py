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


class Recurrent(ForwardModel[SoundConfig]):
    """Rolls out in a latent space, and offers all that makes planning faster."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "Nobody: Nothing, 2026"
    Config: ClassVar[type] = SoundConfig

    def __init__(self, config, inputs) -> None:
        super().__init__(config, inputs)
        self.encoder = nn.Conv2d(6, 4, 1)
        self.action = nn.Embedding(len(inputs.actions), 4)
        self.decoder = nn.Conv2d(4, 3, 1)

    def losses(self, batch):
        state = self.advance(self.begin(batch.previous, batch.current), batch.action)
        return Losses(total=(self.frame(state) - batch.next).square().mean())

    def begin(self, previous, current):
        return (self.encoder(torch.cat([previous, current], 1)),)

    def advance(self, state, action):
        return (torch.tanh(state[0] + self.action(action)[..., None, None]),)

    def frame(self, state):
        return self.decoder(state[0]).float()

    def branch(self, state, parent, action):
        return self.advance((state[0][parent],), action)

    def pixels(self, state):
        return ((self.frame(state).clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8).movedim(1, -1)

    def features(self, state):
        return state[0].flatten(1)

    def embedding(self, state):
        return state[0]


class Reading(SoundVideo):
    """Tells which latent action it reads off frames."""

    def latent_action(self, previous, current, following):
        return self._code(current, following)

    def predict_with_latent(self, previous, current, latent):
        return self._coded(previous, current, latent)

    def branch_with_latent(self, state, parent, latent):
        previous, current = (part[parent] for part in state)
        return current, self._coded(previous, current, latent)


def begun_with(extra: Any, base: type = Sound) -> Any:
    """An ``__init__`` that does something besides that of another model."""

    def init(self: Any, config: Any, inputs: Any) -> None:
        base.__init__(self, config, inputs)
        extra(self)

    return init


def breaks(base: type, **changes: Any) -> type:
    """A class that does something else than ``base``."""
    return type("Broken", (base,), changes)
