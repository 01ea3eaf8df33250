"""E-D CNN: predicts the next frame from the last two and the action, end to end (after Finn, Goodfellow, Levine 2016).

The paper's strongest supervised baseline. To make the comparison one of *methods*, its network is DMotion's interaction
learner with the agent's moved map replaced by the action itself: the one-hot action, tiled, enters at the same three
depths (settled so in docs/models; the paper gives no layers). Loss: mean squared error of the next frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from baselines.layers import check_size, squared_error
from baselines.own_frames import WITH_OWN_FRAMES, OwnFrames, Step
from baselines.patches import pack, rows_of
from baselines.recipe import compact_recipe
from baselines.two_frames import Packed, TwoFrameModel
from baselines.unet import CodedUNet, UNetConfig
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions
from dmotion_bench.learning.model import Losses, ModelInputs, Phase, TrainingConfig, TripletBatch
from dmotion_bench.learning.settings import only_with
from dmotion_bench.specs import Preset, Supervision


@dataclass(frozen=True, kw_only=True)
class EncoderDecoderConfig(UNetConfig):
    """The choices of DMotion's interaction learner that do not concern the agent's map.

    Attributes:
        second_frame: Whether the network sees x_{t-1}, as in the paper.
        own_frames, own_steps: As DMotion's: the share of the triplets, at the end of the training, that are predicted
            from frames that the model drew itself, and the most steps in which it does so (``own_frames.py``).
    """

    second_frame: bool = True
    own_frames: float = 0.0
    own_steps: int = only_with(4, *WITH_OWN_FRAMES)

    def __post_init__(self) -> None:
        OwnFrames(self.own_frames, self.own_steps)  # refuses what cannot be
        super().__post_init__()


class EncoderDecoder(TwoFrameModel[EncoderDecoderConfig]):
    """Predicts pixels from pixels and the action."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = (
        "Finn, Goodfellow, Levine: Unsupervised Learning for Physical Interaction through Video Prediction, "
        "NeurIPS 2016"
    )
    Config: ClassVar[type] = EncoderDecoderConfig

    def __init__(self, config: EncoderDecoderConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("the E-D CNN", inputs)
        self.encoding = ActionEncoding(inputs.actions)
        self.network = CodedUNet(self.encoding.width, 2 if config.second_frame else 1, config)
        self.own_frames = OwnFrames(config.own_frames, config.own_steps)

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """DMotion's settings."""
        return compact_recipe(preset, passes=2)

    def phases(self) -> tuple[Phase, ...]:
        """One, of labelled triplets; with what came before them if the model is to predict from its own frames."""
        return (Phase(needs_actions=True, earlier=self.own_frames.earlier),)

    def progress(self, share: float) -> None:
        """Predict from ever more own frames."""
        self.own_frames.progress(share)

    def losses(self, batch: TripletBatch) -> Losses:
        """Squared error in [-1, 1] units, averaged over pixels and channels."""
        assert batch.action is not None, "the loop gives labelled triplets to models of Supervision.ACTIONS"
        frames = pack(batch.previous), pack(batch.current)
        if self.training and (own := self.own_frames.of(batch, pack, self._followed, needs_actions=True)) is not None:
            frames = own.put_into(*frames)
        _, predicted = self.branch(frames, None, batch.action)
        each = squared_error(predicted, pack(batch.next))
        prediction = each.mean()
        return Losses(total=prediction, terms={"prediction": prediction.detach()}, per_triplet=each.detach())

    def _followed(self, previous: Tensor, current: Tensor, step: Step) -> Float[Tensor, "b p hp wp"]:
        """The next frame, packed, after the action of a step."""
        assert step.action is not None, "it is asked for"
        _, predicted = self.branch((previous, current), None, step.action)
        return predicted

    def _latent_of(self, action: Actions) -> Float[Tensor, "b d"]:
        code: Tensor = self.encoding(action)
        return code

    def _drawn(self, previous: Tensor, current: Tensor, parent: Tensor | None, latent: Tensor) -> Packed:
        frames, last = [previous, current] if self.config.second_frame else [current], rows_of(current, parent)
        code = latent.to(current.dtype)
        return last, self.network(frames, code, parent=parent, current=last)
