"""World Models (Ha, Schmidhuber 2018), as the paper's baselines WM-AE and WM-VAE use them.

Two phases. First an autoencoder of single frames, deterministic or variational, learns a code z from all video, without
actions. Then it is frozen and a transition model learns z_{t+1} from (z_{t-1}, z_t, a_t) with the action labels.
The prediction decodes z_{t+1}.

Settled so (docs/models): the transition is a deterministic network, not the original's mixture-density RNN over
whole sequences: the paper predicts one step from two frames. It predicts the change of z. The code is a
linear map of the encoder's last features and read by one, as in the original.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from baselines.gaussian import Gaussian
from baselines.layers import SLOPE, FrameDecoder, FrameEncoder, check_size, linear, reconstruction_losses, squared_error
from baselines.patches import pack, unpack
from baselines.recipe import compact_recipe
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, Phase, TrainingConfig, TripletBatch
from dmotion_bench.learning.settings import only_with
from dmotion_bench.specs import Preset, Supervision

AUTOENCODER = Phase(name="autoencoder", fraction=0.5)
TRANSITION = Phase(name="transition", fraction=0.5, needs_actions=True)


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig:
    """The choices that the paper leaves open.

    Attributes:
        latent: Length of the code z; 32 in the original, for smaller frames of one road.
        hidden: Width of the transition's two hidden layers.
        beta: Weight of the VAE's KL divergence against the squared error summed over the pixels of images in [0, 1]; 1
            in the original, which blurs small objects (docs/models); the deterministic autoencoder has none.
    """

    latent: int = 256
    hidden: int = 512
    beta: float = 0.05

    def __post_init__(self) -> None:
        if self.latent < 1 or self.hidden < 1 or self.beta < 0:
            raise InvalidSetting("latent and hidden must be 1 or more, beta 0 or more.")


@dataclass(frozen=True, kw_only=True)
class AutoencoderConfig(WorldModelConfig):
    """The same, of which the deterministic autoencoder has no use for ``beta``."""

    beta: float = only_with(WorldModelConfig.beta, "the variational code of wm-vae", lambda _: False)


class AutoencoderWorldModel(ForwardModel[WorldModelConfig]):
    """WM-AE: the code is deterministic."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "Ha, Schmidhuber: Recurrent World Models Facilitate Policy Evolution, NeurIPS 2018"
    Config: ClassVar[type] = AutoencoderConfig

    def __init__(self, config: WorldModelConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("a world model", inputs)
        self.encoder = FrameEncoder(inputs, self._moments() * config.latent)
        self.decoder = FrameDecoder(inputs, config.latent, hidden=None)
        gain = nn.init.calculate_gain("leaky_relu", SLOPE)
        self.encoding = ActionEncoding(inputs.actions)
        self.transition = nn.Sequential(
            linear(2 * config.latent + self.encoding.width, config.hidden, gain),
            nn.LeakyReLU(SLOPE),
            linear(config.hidden, config.hidden, gain),
            nn.LeakyReLU(SLOPE),
            linear(config.hidden, config.latent, 0.1),
        )
        self.phase = AUTOENCODER

    @classmethod
    def _moments(cls) -> int:
        return 1

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """DMotion's settings."""
        return compact_recipe(preset, passes=3)

    def phases(self) -> tuple[Phase, ...]:
        """The code first, from all video; then its dynamics, from what is labelled."""
        return AUTOENCODER, TRANSITION

    def enter(self, phase: Phase) -> None:
        """Freeze the parameters that the other phase trains."""
        self.phase = phase
        for part in (self.encoder, self.decoder):
            part.requires_grad_(phase == AUTOENCODER)
        self.transition.requires_grad_(phase == TRANSITION)

    def losses(self, batch: TripletBatch) -> Losses:
        """Reconstruction in the first phase, squared error of the code in the second."""
        if self.phase == AUTOENCODER:
            return self._reconstruction(batch.current)
        assert batch.action is not None, "the loop gives labelled triplets in a phase that needs actions"
        with torch.no_grad():
            codes = self.code(torch.cat([batch.previous, batch.current, batch.next]))
        previous, current, following = codes.chunk(3)
        predicted = self._step(previous, current, batch.action)
        each = squared_error(predicted, following)
        transition = each.mean()
        terms = {"transition": transition.detach()}
        if not self.training:
            terms["prediction"] = F.mse_loss(self._decode(predicted), batch.next)
        return Losses(total=transition, terms=terms, per_triplet=each.detach())

    def _reconstruction(self, image: Float[Tensor, "b c h w"]) -> Losses:
        packed = pack(image)
        return reconstruction_losses(self.decoder(self.encoder(packed)), packed)

    def code(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d"]:
        """z of a frame."""
        code: Tensor = self.encoder(pack(image))
        return code

    def begin(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]:
        """The codes of both frames."""
        return self.code(previous), self.code(current)

    def advance(
        self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]], action: Actions
    ) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]:
        """The codes one action later."""
        previous, current = state
        return current, self._step(previous, current, action)

    def embedding(self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]) -> Float[Tensor, "b d"]:
        """The last code."""
        return state[1]

    def frame(self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]) -> Float[Tensor, "b c h w"]:
        """The last code, decoded."""
        return self._decode(state[1])

    def _step(
        self, previous: Float[Tensor, "b d"], current: Float[Tensor, "b d"], action: Actions
    ) -> Float[Tensor, "b d"]:
        chosen = self.encoding(action).to(current.dtype)
        change: Tensor = self.transition(torch.cat([previous, current, chosen], dim=1))
        return current + change

    def _decode(self, code: Float[Tensor, "b d"]) -> Float[Tensor, "b c h w"]:
        return unpack(self.decoder(code)).float()


class VariationalWorldModel(AutoencoderWorldModel):
    """WM-VAE: the code is a Gaussian; the transition works on its mean."""

    Config: ClassVar[type] = WorldModelConfig

    @classmethod
    def _moments(cls) -> int:
        return 2

    def code(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d"]:
        """The mean of z."""
        code: Tensor = self.encoder(pack(image)).chunk(2, dim=1)[0]
        return code

    def _reconstruction(self, image: Float[Tensor, "b c h w"]) -> Losses:
        """The evidence bound, per pixel and in [-1, 1] units: sum of squares in [0, 1] + beta KL, times 4 / pixels."""
        packed = pack(image)
        code = Gaussian.of(self.encoder(packed))
        drawn = code.sample() if self.training else code.mean
        losses, divergence = reconstruction_losses(self.decoder(drawn.to(packed.dtype)), packed), code.divergence()
        weight = 4 * self.config.beta / image[0].numel()
        return dataclasses.replace(
            losses,
            total=losses.total + weight * divergence,
            terms={**losses.terms, "divergence": divergence.detach()},
        )
