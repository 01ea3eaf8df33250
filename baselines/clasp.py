"""CLASP (Rybkin, Pertsch et al. 2019): latent actions that are minimal and composable.

A recurrent predictor is given, at each step, x_t and a latent action z_t, a Gaussian inferred from x_t and x_{t+1}.
Two things make z an action (its section 3). The divergence from the unit Gaussian, weighted by beta, keeps out of z
what x_t tells already. And a composition network merges the latent actions of several steps into one, nu, from which
the predictor must reach the last frame in a single step from the first.

Settled so (docs/models): sequences are the benchmark's triplets, so two latent actions are composed, and of the
step-by-step predictions the last one is trained. Inference, predictor and decoder are of the shared backbone: the
predictor's state enters a U-Net, whose skip connections are the original's, and z beside it: through the recurrent
state alone z stayed unused for 700 steps (decision 025). The alignment is ``ActionToLatent``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from baselines.gaussian import Gaussian
from baselines.layers import SLOPE, FrameEncoder, MotionTrunk, check_size, linear, squared_error
from baselines.patches import pack, unpack
from baselines.recipe import compact_recipe
from baselines.unet import CodedUNet, UNetConfig
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import Actions
from dmotion_bench.learning.action_to_latent import ActionToLatent
from dmotion_bench.learning.model import (
    Demonstrations,
    ForwardModel,
    Losses,
    ModelInputs,
    TrainingConfig,
    TripletBatch,
)
from dmotion_bench.specs import Preset, Supervision

Memory = tuple[Tensor, Tensor]
"""The predictor's hidden state and cell."""


@dataclass(frozen=True, kw_only=True)
class ClaspConfig(UNetConfig):
    """The choices that the paper leaves open.

    Attributes:
        length: Numbers in a latent action.
        beta: Weight of the divergence [per nat] of each latent action, composed ones too, against the mean squared
            error of images in [0, 1].
        warm_up: Share of the training over which beta grows from 0 (Bowman et al. 2016, *Generating sentences from a
            continuous space*). Else the divergence may empty the latent actions before the predictor uses them.
        hidden: Width of the recurrent predictor and of the composition network.
    """

    length: int = 16
    beta: float = 2e-4
    warm_up: float = 0.0
    hidden: int = 128

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.length < 1 or self.hidden < 1 or self.beta < 0:
            raise InvalidSetting("length and hidden must be 1 or more, beta 0 or more.")
        if not 0 <= self.warm_up <= 1:
            raise InvalidSetting("warm_up must be 0 to 1.")


class Clasp(ForwardModel[ClaspConfig]):
    """Learns from video alone; a few demonstrations tell it afterwards which latent action each action is."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = (
        "Rybkin, Pertsch, Derpanis, Daniilidis, Jaegle: Learning what you can do before doing anything, ICLR 2019"
    )
    Config: ClassVar[type] = ClaspConfig

    def __init__(self, config: ClaspConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("CLASP", inputs)
        gain = nn.init.calculate_gain("leaky_relu", SLOPE)
        self.trunk = MotionTrunk(frames=2)
        self.moments = linear(MotionTrunk.length, 2 * config.length, 0.5)
        self.composition = nn.Sequential(
            linear(2 * config.length, config.hidden, gain),
            nn.LeakyReLU(SLOPE),
            linear(config.hidden, 2 * config.length, 0.5),
        )
        self.scene = FrameEncoder(inputs, config.hidden)
        self.predictor = nn.LSTMCell(config.hidden + config.length, config.hidden)
        self.decoder = CodedUNet(config.hidden + config.length, frames=1, config=config)
        self.table = ActionToLatent(inputs.actions, config.length)
        self.beta = config.beta

    @classmethod
    def configure(cls, arch: str) -> ClaspConfig:
        """Beta grows at first."""
        return ClaspConfig(warm_up=0.2)

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """DMotion's settings; a triplet takes 1.5 times as long as with DMotion."""
        return compact_recipe(preset, passes=0.7)

    def progress(self, share: float) -> None:
        """Let beta grow."""
        self.beta = self.config.beta * (min(1.0, share / self.config.warm_up) if self.config.warm_up else 1.0)

    def losses(self, batch: TripletBatch) -> Losses:
        """x_{t+1} step by step and in one composed step, in [-1, 1] units (four times [0, 1]'s); divergences."""
        previous, current, following = pack(batch.previous), pack(batch.current), pack(batch.next)
        first, second = self._infer(previous, current), self._infer(current, following)
        drawn = [latent.sample() if self.training else latent.mean for latent in (first, second)]
        merged = self.compose(*drawn)
        seen = self.scene(previous)
        memory = self._remember(seen, drawn[0], None)
        stepwise, _ = self._step(current, self.scene(current), drawn[1], memory)
        composed, _ = self._step(previous, seen, merged.sample() if self.training else merged.mean, None)
        each = squared_error(stepwise, following)
        prediction, composition = each.mean(), squared_error(composed, following).mean()
        divergence = first.divergence() + second.divergence() + merged.divergence()
        beta = self.beta if self.training else self.config.beta  # validation losses are compared with each other
        return Losses(
            total=prediction + composition + 4 * beta * divergence,
            terms={
                "prediction": prediction.detach(),
                "composition": composition.detach(),
                "divergence": divergence.detach(),
            },
            per_triplet=each.detach(),
        )

    def compose(self, earlier: Float[Tensor, "b d"], later: Float[Tensor, "b d"]) -> Gaussian:
        """nu: the latent action that has the effect of two latent actions in a row."""
        return Gaussian.of(self.composition(torch.cat([earlier, later], dim=1)))

    def latent_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Float[Tensor, "b d"]:
        """The mean of z between x_t and x_{t+1}; it does not depend on x_{t-1}."""
        return self._infer(pack(current), pack(following)).mean

    def predict_with_latent(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        latent: Float[Tensor, "b d"],
    ) -> Float[Tensor, "b c h w"]:
        """One step of the predictor under a latent action."""
        frame, hidden, cell = self.begin(previous, current)
        packed = pack(frame)
        predicted, _ = self._step(packed, self.scene(packed), latent, (hidden, cell))
        return unpack(predicted).float()

    @torch.no_grad()
    def align(self, demonstrations: Demonstrations) -> None:
        """Learn the z of each action."""
        self.table.fit(demonstrations.read(self.latent_action), demonstrations.action)

    def begin(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b m"], Float[Tensor, "b m"]]:
        """The state: x_t, and the memory of the recurrent predictor."""
        latent = self._infer(pack(previous), pack(current)).mean
        return (current, *self._remember(self.scene(pack(previous)), latent, None))

    def advance(
        self,
        state: tuple[Float[Tensor, "b c h w"], Float[Tensor, "b m"], Float[Tensor, "b m"]],
        action: Actions,
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b m"], Float[Tensor, "b m"]]:
        """One step of the predictor under the action's z."""
        current, hidden, cell = state
        packed = pack(current)
        predicted, (hidden, cell) = self._step(packed, self.scene(packed), self.table(action), (hidden, cell))
        return unpack(predicted).float(), hidden, cell

    def frame(
        self, state: tuple[Float[Tensor, "b c h w"], Float[Tensor, "b m"], Float[Tensor, "b m"]]
    ) -> Float[Tensor, "b c h w"]:
        """The last frame predicted."""
        return state[0]

    def _infer(self, current: Tensor, following: Tensor) -> Gaussian:
        return Gaussian.of(self.moments(self.trunk.summarise([current, following])))

    def _remember(self, seen: Float[Tensor, "b m"], latent: Float[Tensor, "b d"], memory: Memory | None) -> Memory:
        """One step of the recurrent predictor, which is told what ``scene`` sees in a frame."""
        hidden, cell = self.predictor(torch.cat([seen, latent.to(seen.dtype)], dim=1), memory)
        return hidden.float(), cell.float()

    def _step(
        self, frame: Tensor, seen: Float[Tensor, "b m"], latent: Float[Tensor, "b d"], memory: Memory | None
    ) -> tuple[Tensor, Memory]:
        memory = self._remember(seen, latent, memory)
        code = torch.cat([memory[0], latent.float()], dim=1)
        return self.decoder([frame], code.to(frame.dtype)), memory
