"""A continuous latent-action model, as AdaWorld's (Gao et al. 2025): a variational autoencoder of what changes.

From two frames the encoder infers a Gaussian over a short latent action; the decoder predicts the second frame from the
first and a draw of it. The divergence from the unit Gaussian, weighted by beta, leaves in the latent action only what
the first frame cannot tell.

AdaWorld's sizes: 32 numbers, beta 2e-4, against the squared error of images in [0, 1]. Settled so (docs/models):
encoder and decoder are of the shared backbone instead of spatio-temporal transformers, and the decoder sees
(x_{t-1}, x_t), like every model here; the alignment is a table of the mean latent action of each action's
demonstrations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from baselines.gaussian import Gaussian
from baselines.layers import MotionTrunk, check_size, linear, squared_error
from baselines.patches import pack, rows_of
from baselines.recipe import compact_recipe
from baselines.two_frames import Packed, TwoFrameModel
from baselines.unet import CodedUNet, UNetConfig
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_to_latent import ActionToLatent
from dmotion_bench.learning.model import (
    Demonstrations,
    Losses,
    ModelInputs,
    TrainingConfig,
    TripletBatch,
)
from dmotion_bench.specs import Preset, Supervision


@dataclass(frozen=True, kw_only=True)
class LatentActionConfig(UNetConfig):
    """AdaWorld's choices.

    Attributes:
        length: Numbers in a latent action.
        beta: Weight of the divergence [per nat] against the mean squared error of images in [0, 1].
    """

    length: int = 32
    beta: float = 2e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.length < 1 or self.beta < 0:
            raise InvalidSetting("length must be 1 or more, beta 0 or more.")


class LatentActionVAE(TwoFrameModel[LatentActionConfig]):
    """Learns from video alone; a few demonstrations tell it afterwards which latent action each action is."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = (
        "Gao, Zhou, Du, Zhang, Gan: AdaWorld: Learning Adaptable World Models with Latent Actions, ICML 2025"
    )
    Config: ClassVar[type] = LatentActionConfig

    def __init__(self, config: LatentActionConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("the latent-action VAE", inputs)
        self.trunk = MotionTrunk(frames=2)
        self.moments = linear(MotionTrunk.length, 2 * config.length, 0.5)
        self.decoder = CodedUNet(config.length, config=config)
        self.table = ActionToLatent(inputs.actions, config.length)

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """DMotion's settings."""
        return compact_recipe(preset, passes=1.5)

    def losses(self, batch: TripletBatch) -> Losses:
        """Squared error of x_{t+1} in [-1, 1] units (four times that in [0, 1]) and the weighted divergence."""
        previous, current, following = pack(batch.previous), pack(batch.current), pack(batch.next)
        latent = self._infer(current, following)
        drawn = latent.sample() if self.training else latent.mean
        predicted = self.decoder([previous, current], drawn.to(current.dtype))
        each = squared_error(predicted, following)
        prediction, divergence = each.mean(), latent.divergence()
        return Losses(
            total=prediction + 4 * self.config.beta * divergence,
            terms={"prediction": prediction.detach(), "divergence": divergence.detach()},
            per_triplet=each.detach(),
        )

    def latent_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Float[Tensor, "b d"]:
        """The mean latent action between x_t and x_{t+1}; it does not depend on x_{t-1}."""
        return self._infer(pack(current), pack(following)).mean

    @torch.no_grad()
    def align(self, demonstrations: Demonstrations) -> None:
        """Learn the latent action of each action."""
        self.table.fit(demonstrations.read(self.latent_action), demonstrations.action)

    def _drawn(self, previous: Tensor, current: Tensor, parent: Tensor | None, latent: Tensor) -> Packed:
        frames, last = [previous, current], rows_of(current, parent)
        return last, self.decoder(frames, latent.to(current.dtype), parent=parent, current=last)

    def _infer(self, current: Tensor, following: Tensor) -> Gaussian:
        return Gaussian.of(self.moments(self.trunk.summarise([current, following])))
