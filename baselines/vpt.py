"""Inverse-dynamics relabelling, as VPT (Baker et al. 2022): few labels name all the video, and a model learns from it.

VPT's section 3 has two steps. An inverse model learns from a few labelled transitions which action lies between the
frames; it may look at the frames after the action too, so it needs far fewer labels than a policy (its figure 2). Then
it names every action of the video, and what follows learns from these names as if they were labels. VPT clones a
policy; the benchmark wants a forward model, so here E-D CNN (``encoder_decoder.py``) learns from the named video.

Settled so (docs/models): the inverse model is the trunk by which the other models infer latent actions, over
(x_t, x_{t+1}), in place of a ResNet and a transformer over 128 frames; while it learns, the frames of a batch are
rolled by the same random shift, since few labels show few places; the names are its most likely actions, as VPT's, or
its estimates of continuous ones; and it is no longer trained once it names. An action that no label shows is never
named.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from baselines.layers import MotionTrunk, check_size, left_to_adam, linear, squared_error
from baselines.patches import pack, unpack
from baselines.recipe import compact_recipe
from baselines.unet import CodedUNet, UNetConfig
from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, Phase, TrainingConfig, TripletBatch
from dmotion_bench.specs import Preset, Supervision

INVERSE = Phase(name="inverse", fraction=0.2, needs_actions=True)
FORWARD = Phase(name="forward", fraction=0.8)
STRIDE = 16  # [px]: a roll by so many changes nothing for the trunk


@dataclass(frozen=True, kw_only=True)
class RelabellingConfig(UNetConfig):
    """The choices that the published method leaves open, and those of the forward model's network.

    Attributes:
        frames: How many frames the inverse model sees: x_t and x_{t+1}, or x_{t-1} before them. A third frame tells of
            velocities, and takes more labels to be told from chance.
    """

    frames: Literal[2, 3] = 2


class InverseModel(nn.Module):
    """Which action lies between x_t and x_{t+1}: a score for each discrete one, or the numbers of a continuous one."""

    def __init__(self, actions: ActionSpec | None, frames: int) -> None:
        super().__init__()
        self.encoding, self.frames = ActionEncoding(actions), frames
        self.trunk = MotionTrunk(frames=frames)
        self.out = linear(MotionTrunk.length, self.encoding.width, 0.1)
        left_to_adam(*self.out.parameters())

    def forward(
        self,
        previous: Float[Tensor, "b p hp wp"],
        current: Float[Tensor, "b p hp wp"],
        following: Float[Tensor, "b p hp wp"],
    ) -> Float[Tensor, "b a"]:
        """Logits, or normalised numbers."""
        scores: Tensor = self.out(self.trunk.summarise([previous, current, following][-self.frames :]))
        return scores.float()

    def errors(self, scores: Float[Tensor, "b a"], action: Actions) -> Float[Tensor, " b"]:
        """What the scores cost if this is the action: cross-entropy [nats], or the squared error."""
        if isinstance(self.encoding.spec, Continuous):
            wanted: Tensor = self.encoding(action)
            return (scores - wanted).square().mean(1)
        return F.cross_entropy(scores, action, reduction="none")

    def named(self, scores: Float[Tensor, "b a"]) -> Actions:
        """The likeliest action, or the estimate, within its bounds and in its units."""
        if isinstance(self.encoding.spec, Continuous):
            estimate: Tensor = self.encoding.middle + scores.clamp(-1, 1) * self.encoding.reach
            return estimate
        return scores.argmax(1)


class InverseRelabelling(ForwardModel[RelabellingConfig]):
    """Learns from video whose actions its inverse model names; the inverse model learns from the budget's labels."""

    supervision: ClassVar[Supervision] = Supervision.FEW
    paper: ClassVar[str] = (
        "Baker, Akkaya, Zhokhov, Huizinga, Tang, Ecoffet, Houghton, Sampedro, Clune: Video PreTraining (VPT): Learning "
        "to Act by Watching Unlabeled Online Videos, NeurIPS 2022"
    )
    Config: ClassVar[type] = RelabellingConfig

    def __init__(self, config: RelabellingConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("inverse-dynamics relabelling", inputs)
        self.inverse = InverseModel(inputs.actions, config.frames)
        self.encoding = ActionEncoding(inputs.actions)
        self.network = CodedUNet(self.encoding.width, config=config)
        self.phase = INVERSE

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """E-D CNN's settings, and a quarter more for the inverse model."""
        return compact_recipe(preset, passes=2.5)

    def phases(self) -> tuple[Phase, ...]:
        """The inverse model first, from what is labelled; then the forward model, from all video."""
        return INVERSE, FORWARD

    def enter(self, phase: Phase) -> None:
        """Freeze what the other phase trains."""
        self.phase = phase
        self.inverse.requires_grad_(phase == INVERSE)
        self.network.requires_grad_(phase == FORWARD)

    def losses(self, batch: TripletBatch) -> Losses:
        """The inverse model's error in the first phase; then the forward model's, in squared [-1, 1] units."""
        if self.phase == INVERSE:
            assert batch.action is not None, "the loop gives labelled triplets in a phase that needs actions"
            images = self._rolled(torch.stack([batch.previous, batch.current, batch.next]))
            each = self.inverse.errors(self.inverse(*map(pack, images)), batch.action)
            inverse = each.mean()
            return Losses(total=inverse, terms={"inverse": inverse.detach()}, per_triplet=each.detach())
        previous, current, following = pack(batch.previous), pack(batch.current), pack(batch.next)
        scores = self.inverse(previous, current, following)
        each = squared_error(self._next(previous, current, self.inverse.named(scores)), following)
        prediction = each.mean()
        return Losses(total=prediction, terms={"prediction": prediction.detach()}, per_triplet=each.detach())

    def infer_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Actions:
        """The action that the inverse model names between ``current`` and ``following``."""
        return self.inverse.named(self.inverse(pack(previous), pack(current), pack(following)))

    def predict(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        action: Actions,
    ) -> Float[Tensor, "b c h w"]:
        """The forward model's output."""
        return unpack(self._next(pack(previous), pack(current), action)).float()

    def _rolled(self, images: Float[Tensor, "t b c h w"]) -> Float[Tensor, "t b c h w"]:
        """All images of a batch moved alike, by less than the trunk's stride; in evaluation as they are."""
        if not self.training:
            return images
        down, right = torch.randint(STRIDE, (2,)).tolist()
        return images.roll((down, right), dims=(-2, -1))

    def _next(self, previous: Tensor, current: Tensor, action: Actions) -> Float[Tensor, "b p hp wp"]:
        code = self.encoding(action).to(current.dtype)
        predicted: Tensor = self.network([previous, current], code)
        return predicted
