"""A joint-embedding predictive world model from pixels, as LeWorldModel (Maes et al. 2026).

An encoder embeds single frames, a predictor embeds the next frame from the last embeddings and the action; both are
trained together by two losses: the squared error of the predicted embedding, without a stop-gradient, and SIGReg
(Balestriero, LeCun 2025), which keeps the embeddings an isotropic Gaussian, so that they cannot collapse. No
pixel is predicted. Since LeWorldModel is told the actions, this model is, too (``Supervision.ACTIONS``).

The benchmark wants frames: in a second phase the embedding is frozen and a decoder is trained on video, as the authors
do to look into theirs. Nothing of it reaches the embedding.

Batches are of a few episodes, sixteen moments of each. Where every episode has a scene of its own, a code of the scene
alone is as Gaussian over many episodes as one could wish, and the easiest of all to predict; among a few it is not.

Settled so (docs/models): the encoder is of the shared backbone instead of a ViT; the predictor sees two frames,
not three, and is a residual MLP instead of a transformer; it is modulated by the action (AdaLN) as theirs. The
projector with its batch normalisation, lambda, knots, projections, dropout and length of the embedding are theirs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from baselines.layers import FrameDecoder, FrameEncoder, check_size, left_to_adam, reconstruction_losses
from baselines.patches import pack, unpack
from baselines.recipe import compact_recipe
from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import Actions, action_embedding
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, Phase, TrainingConfig, TripletBatch
from dmotion_bench.specs import Preset, Supervision

EMBEDDING = Phase(name="embedding", fraction=0.6, needs_actions=True)
DECODER = Phase(name="decoder", fraction=0.4, batch_size=32)

KNOTS = 17
FARTHEST_KNOT = 3.0


@dataclass(frozen=True, kw_only=True)
class JepaConfig:
    """Length, lambda, projections and dropout's rate are LeWorldModel's; widths and depth are smaller.

    Attributes:
        length: Of an embedding.
        regularisation: lambda, the weight of SIGReg.
        projections: Random directions that SIGReg looks along, anew in each step.
        hidden: Width of projectors and predictor.
        depth: Residual layers of the predictor.
        dropout: In the predictor.
        moments: Of each episode that stand side by side in a batch; 1 draws them all at random, as the authors do.
    """

    length: int = 192
    regularisation: float = 0.09
    projections: int = 1024
    hidden: int = 512
    depth: int = 2
    dropout: float = 0.1
    moments: int = 16

    def __post_init__(self) -> None:
        if min(self.length, self.projections, self.hidden, self.depth, self.moments) < 1:
            raise InvalidSetting("length, projections, hidden, depth and moments must be 1 or more.")
        if self.regularisation < 0 or not 0 <= self.dropout < 1:
            raise InvalidSetting("regularisation must be 0 or more, dropout in [0, 1).")


class Projector(nn.Sequential):
    """One hidden layer with batch normalisation."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__(nn.Linear(inputs, hidden), nn.BatchNorm1d(hidden), nn.GELU(), nn.Linear(hidden, outputs))


class ModulatedLayer(nn.Module):
    """A residual layer that the action scales, shifts and gates; at first it changes nothing (AdaLN-zero)."""

    def __init__(self, width: int, actions: ActionSpec | None, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.layers = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Dropout(dropout), nn.Linear(width, width))
        self.modulation = action_embedding(actions, 3 * width)
        for weight in self.modulation.parameters():
            nn.init.zeros_(weight)
            left_to_adam(weight)

    def forward(self, features: Float[Tensor, "b d"], action: Actions) -> Float[Tensor, "b d"]:
        scale, shift, gate = self.modulation(action).chunk(3, dim=1)
        change: Tensor = self.layers(self.norm(features) * (1 + scale) + shift)
        modulated: Tensor = features + gate * change
        return modulated


class Predictor(nn.Module):
    """Predicts the next embedding from the last two and the action."""

    def __init__(self, config: JepaConfig, actions: ActionSpec | None) -> None:
        super().__init__()
        self.entry = nn.Linear(2 * config.length, config.hidden)
        self.layers = nn.ModuleList(ModulatedLayer(config.hidden, actions, config.dropout) for _ in range(config.depth))
        self.projector = Projector(config.hidden, config.hidden, config.length)

    def forward(
        self, previous: Float[Tensor, "b d"], current: Float[Tensor, "b d"], action: Actions
    ) -> Float[Tensor, "b d"]:
        features = self.entry(torch.cat([previous, current], dim=1))
        for layer in self.layers:
            features = layer(features, action)
        embedding: Tensor = self.projector(features)
        return embedding.float()


def _twice(batch: TripletBatch) -> TripletBatch:
    """Each triplet two times."""
    assert batch.action is not None
    previous, current, following, action = (
        torch.cat([one, one]) for one in (batch.previous, batch.current, batch.next, batch.action)
    )
    return TripletBatch(previous=previous, current=current, next=following, action=action)


def sketched_gaussianity(embeddings: Float[Tensor, "t b d"], directions: Float[Tensor, "d m"]) -> Float[Tensor, ""]:
    """SIGReg: how far the batch is from an isotropic Gaussian (Balestriero, LeCun 2025, section 4).

    The batch is projected on unit ``directions``. Along each the Epps-Pulley statistic compares the empirical
    characteristic function with the Gaussian's, squared and weighted by a Gaussian window, by the trapezoid rule.
    """
    knots = torch.linspace(0, FARTHEST_KNOT, KNOTS, device=embeddings.device)
    gaussian = torch.exp(-knots.square() / 2)
    weights = torch.full_like(knots, 2 * FARTHEST_KNOT / (KNOTS - 1)) * gaussian
    weights[[0, -1]] /= 2
    angles = (embeddings.float() @ (directions / directions.norm(dim=0)))[..., None] * knots
    error = (angles.cos().mean(1) - gaussian).square() + angles.sin().mean(1).square()
    statistic: Tensor = (error @ weights).mean() * embeddings.shape[1]
    return statistic


class LatentWorldModel(ForwardModel[JepaConfig]):
    """Predicts embeddings; a decoder that is trained afterwards draws them as frames."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = (
        "Maes, Le Lidec, Scieur, LeCun, Balestriero: LeWorldModel: Stable End-to-End Joint-Embedding Predictive "
        "Architecture from Pixels, arXiv 2603.19312, 2026"
    )
    Config: ClassVar[type] = JepaConfig

    def __init__(self, config: JepaConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("the latent world model", inputs)
        self.encoder = FrameEncoder(inputs, config.hidden)
        self.projector = Projector(config.hidden, config.hidden, config.length)
        self.predictor = Predictor(config, inputs.actions)
        self.decoder = FrameDecoder(inputs, config.length, hidden=256)
        self.phase = EMBEDDING

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """Batches of 128, as the authors': SIGReg judges a batch's distribution. The decoder has the usual ones."""
        return dataclasses.replace(compact_recipe(preset, passes=2.5), batch_size=128)

    def phases(self) -> tuple[Phase, ...]:
        """Embeddings and their dynamics first, from what is labelled; then the decoder, from all video."""
        return dataclasses.replace(EMBEDDING, together=self.config.moments), DECODER

    def enter(self, phase: Phase) -> None:
        """Freeze the parameters and batch statistics that the other phase trains."""
        self.phase = phase
        for part in (self.encoder, self.projector, self.predictor):
            part.requires_grad_(phase != DECODER)
            if phase == DECODER:
                part.eval()
        self.decoder.requires_grad_(phase == DECODER)

    def losses(self, batch: TripletBatch) -> Losses:
        """Prediction and SIGReg in the first phase, the decoder's squared error in the second."""
        if self.phase == DECODER:
            with torch.no_grad():
                embedding = self.embed(batch.current)
            return reconstruction_losses(self._decode(embedding), batch.current)
        assert batch.action is not None, "the loop gives labelled triplets in a phase that needs actions"
        if len(batch.current) == 1:  # under one label; batch normalisation takes two or more
            batch = _twice(batch)
        assert batch.action is not None
        embeddings = rearrange(
            self.embed(torch.cat([batch.previous, batch.current, batch.next])), "(t b) d -> t b d", t=3
        )
        previous, current, following = embeddings.unbind(0)
        prediction = F.mse_loss(self.predictor(previous, current, batch.action), following)
        directions = torch.randn(self.config.length, self.config.projections, device=embeddings.device)
        gaussianity = sketched_gaussianity(embeddings, directions)
        return Losses(
            total=prediction + self.config.regularisation * gaussianity,
            terms={"prediction": prediction.detach(), "gaussianity": gaussianity.detach()},
        )

    def embed(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d"]:
        """A frame's embedding."""
        embedding: Tensor = self.projector(self.encoder(pack(image)))
        return embedding.float()

    def begin(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]:
        """The embeddings of both frames."""
        return self.embed(previous), self.embed(current)

    def advance(
        self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]], action: Actions
    ) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]:
        """The embeddings one action later."""
        previous, current = state
        return current, self.predictor(previous, current, action)

    def embedding(self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]) -> Float[Tensor, "b d"]:
        """The last embedding."""
        return state[1]

    def frame(self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]) -> Float[Tensor, "b c h w"]:
        """The last embedding, decoded."""
        return self._decode(state[1])

    def _decode(self, embedding: Float[Tensor, "b d"]) -> Float[Tensor, "b c h w"]:
        return unpack(self.decoder(embedding)).float()
