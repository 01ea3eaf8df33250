"""A model as people wrote them before channels-last memory: ``view`` after every convolution."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from known_model import NoConfig
from torch import Tensor, nn

from dmotion_bench.learning.model import Demonstrations, ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.specs import Supervision


class OlderNetwork(ForwardModel[NoConfig]):
    """Video alone, a latent action of four numbers, a table."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = "Nobody: Nothing, 2016"
    Config: ClassVar[type] = NoConfig
    table: Tensor

    def __init__(self, config: NoConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.encoder, self.painter = nn.Conv2d(6, 4, 8, stride=8), nn.Conv2d(10, 3, 3, padding=1)
        self.register_buffer("table", torch.zeros(inputs.actions.width, 4))

    def losses(self, batch: TripletBatch) -> Losses:
        latent = self.latent_action(batch.previous, batch.current, batch.next)
        drawn = self.predict_with_latent(batch.previous, batch.current, latent)
        return Losses(total=(drawn - batch.next).square().mean())

    def align(self, demonstrations: Demonstrations) -> None:
        shown = (demonstrations.previous, demonstrations.current, demonstrations.next)
        for action, latent in zip(demonstrations.action, self.latent_action(*shown), strict=True):
            self.table[action] = latent

    def predict(self, previous: Any, current: Any, action: Any) -> Any:
        return self.predict_with_latent(previous, current, self.table[action])

    def latent_action(self, previous: Any, current: Any, following: Any) -> Any:
        features = self.encoder(torch.cat([current, following], 1))
        return features.view(len(current), 4, -1).mean(2)

    def predict_with_latent(self, previous: Any, current: Any, latent: Any) -> Any:
        tiled = latent[:, :, None, None].expand(-1, -1, *current.shape[2:])
        drawn = self.painter(torch.cat([previous, current, tiled], 1))
        return (current + drawn.view(len(current), -1).view(current.shape)).float()
