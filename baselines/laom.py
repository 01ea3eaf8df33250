"""LAOM (Nikulin et al. 2025): latent actions between embeddings, without quantisation, with or without a few labels.

LAPO predicts pixels through a quantised latent action, so that whatever moves in the picture competes for its codes.
LAOM changes four things (its section 4):

- The inverse model infers z_t from the embeddings s_t and s_{t+k}, the forward model predicts s_{t+1} from s_t and z_t:
  nothing is drawn. The target is an encoder that follows the trained one as a running mean (BYOL; its figure 4).
- z_t is a long continuous vector. There is no bottleneck.
- The inverse model looks k steps ahead, k drawn anew for each sample; what an action does not cause is not easier to
  tell from a later frame.
- **A few labels beside each batch of video**: a linear map reads the action from z_t, and its error is added to the
  loss. The paper's finding is that where distractors move, this is needed *during* the training (``laom-labels``);
  without it the model learns from video alone (``laom``).

The benchmark wants frames: in a second phase all that is frozen and a decoder of embeddings is trained on video, as
for C-SWM and JEPA. Nothing of it reaches the embedding.

One thing is ours: **what is inferred from and predicted is the embedding's change** s_{t+1} - s_t, each of its numbers
divided by its standard deviation over the batch (``Changes``). Where most of the picture stands still, an embedding
of what stands still is its own next one, so that the authors' loss becomes small and z_t says nothing of the action
(docs/experiments/labels-during-training.md).

Settled so (docs/models): the encoder is of the shared backbone, over single frames; k is 1 or 2, since a
training sees triplets, and the authors' is 1 to 10; of the authors' augmentations there are small shifts alone, the
same for all frames of a batch of video; both heads are given the embedding normalised to variance 1; and the
alignment goes from an action to z_t by ``ActionToLatent``, from the same labels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from baselines.layers import FrameDecoder, FrameEncoder, check_size, left_to_adam, linear, reconstruction_losses
from baselines.patches import pack, unpack
from baselines.recipe import compact_recipe
from dmotion_bench.actions import Continuous
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions
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

LATENTS = Phase(name="latents", fraction=0.6)
LATENTS_WITH_LABELS = Phase(name="latents", fraction=0.6, with_labels=8)
"""A quarter of a batch of video, as the authors'."""
DECODER = Phase(name="decoder", fraction=0.4)


@dataclass(frozen=True, kw_only=True)
class LaomConfig:
    """The authors' choices, sized for short trainings.

    Attributes:
        length: Of z_t; the authors' is 8192.
        embedding: Of an embedding.
        hidden: Width of the inverse and the forward model; the authors' is 1024.
        ahead: The most steps that the inverse model looks ahead, 1 or 2; the authors' is 10.
        target_rate: How fast the target encoder follows, a step; the authors' is 0.001.
        label_weight: Of the labelled transitions' error; the authors' is 0.001 to 0.05.
        shift: While it learns, the frames of a batch of video are rolled by at most so much either way [px].
        label_shift: The same for labelled transitions, each of which has a shift of its own [px]: few labels show few
            places.
    """

    length: int = 128
    embedding: int = 256
    hidden: int = 256
    ahead: int = 2
    target_rate: float = 0.01
    label_weight: float = 0.5
    shift: int = 4
    label_shift: int = 16

    def __post_init__(self) -> None:
        if min(self.length, self.embedding, self.hidden) < 1 or self.ahead not in (1, 2):
            raise InvalidSetting("length, embedding and hidden must be 1 or more, ahead 1 or 2.")
        if not 0 < self.target_rate <= 1 or min(self.label_weight, self.shift, self.label_shift) < 0:
            raise InvalidSetting("target_rate must be above 0 and at most 1, label_weight and the shifts 0 or more.")


class Head(nn.Module):
    """Three residual layers, each of which is given the condition anew.

    Args:
        inputs, condition, outputs: Their lengths.
        hidden: Width of the layers.
    """

    def __init__(self, inputs: int, condition: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.entries = nn.ModuleList(linear(width + condition, hidden) for width in (inputs, hidden, hidden))
        self.layers = nn.ModuleList(
            nn.Sequential(linear(hidden, 2 * hidden, 2**0.5), nn.ReLU(), linear(2 * hidden, hidden, 0.5))
            for _ in range(3)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(hidden) for _ in range(3))
        self.out = linear(hidden, outputs)

    def forward(self, inputs: Float[Tensor, "b i"], condition: Float[Tensor, "b c"]) -> Float[Tensor, "b o"]:
        features = inputs
        for entry, layer, norm in zip(self.entries, self.layers, self.norms, strict=True):
            entered = entry(torch.cat([features, condition], dim=1))
            features = norm(entered + layer(entered))
        outputs: Tensor = self.out(features)
        return outputs


class Changes(nn.Module):
    """Changes of an embedding in units of their standard deviation, number by number.

    While it learns these are the batch's own, and a running mean of them is kept; otherwise the mean is used.

    Args:
        length: Of the embedding.
    """

    def __init__(self, length: int) -> None:
        super().__init__()
        self.statistics = nn.BatchNorm1d(length, affine=False)

    def forward(self, change: Float[Tensor, "b e"], *, own: bool = True) -> Float[Tensor, "b e"]:
        """Mean 0 and variance 1; by the running mean if ``own`` is false, which leaves it as it is."""
        kept = self.statistics
        if own and len(change) > 1:
            standard: Tensor = kept(change)
            return standard
        return F.batch_norm(change, kept.running_mean, kept.running_var, eps=kept.eps)

    def undone(self, standard: Float[Tensor, "b e"]) -> Float[Tensor, "b e"]:
        """The change itself, by the running mean."""
        mean, variance = self.statistics.running_mean, self.statistics.running_var
        assert mean is not None
        assert variance is not None
        return standard * (variance + self.statistics.eps).sqrt() + mean


class Laom(ForwardModel[LaomConfig]):
    """Learns from video alone; a few demonstrations tell it afterwards which latent action each action is."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = (
        "Nikulin, Zisman, Tarasov, Lyubaykin, Polubarov, Kiselev, Kurenkov: Latent Action Learning Requires "
        "Supervision in the Presence of Distractors, ICML 2025"
    )
    Config: ClassVar[type] = LaomConfig

    def __init__(self, config: LaomConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("LAOM", inputs)
        usual = LaomConfig()
        told = (config.label_weight, config.label_shift) != (usual.label_weight, usual.label_shift)
        if told and self.supervision is Supervision.NONE:
            raise InvalidSetting("label_weight and label_shift are for laom-labels; laom is given no labels to weigh.")
        self.encoder = FrameEncoder(inputs, config.embedding)
        self.target = FrameEncoder(inputs, config.embedding).requires_grad_(False)
        self.target.load_state_dict(self.encoder.state_dict())
        self.changes, self.target_changes = Changes(config.embedding), Changes(config.embedding)
        self.inverse_model = Head(0, 2 * config.embedding, config.hidden, config.length)
        self.forward_model = Head(config.embedding, config.length, config.hidden, config.embedding)
        self.decoder = FrameDecoder(inputs, config.embedding, hidden=256)
        self.table = ActionToLatent(inputs.actions, config.length)
        self.phase = self.phases()[0]

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """As the others', but by Adam, as the authors': with Muon it learns the few labels by heart."""
        return replace(compact_recipe(preset, passes=2.5), optimizer="adam", learning_rate=1e-3)

    def phases(self) -> tuple[Phase, ...]:
        """Embeddings and latent actions first; then the decoder."""
        return LATENTS, DECODER

    def enter(self, phase: Phase) -> None:
        """Freeze what the other phase trains; the target is never trained."""
        self.phase = phase
        self.requires_grad_(phase != DECODER)
        self.decoder.requires_grad_(phase == DECODER)
        self.target.requires_grad_(False)

    @torch.no_grad()
    def progress(self, share: float) -> None:
        """Before every step: the target's weights follow the encoder's."""
        if self.phase != DECODER:
            for slow, fast in zip(self.target.parameters(), self.encoder.parameters(), strict=True):
                slow.lerp_(fast, self.config.target_rate)

    def losses(self, batch: TripletBatch) -> Losses:
        """Squared error of the change as the target has it, and of the labelled actions; then the decoder's."""
        if self.phase == DECODER:
            with torch.no_grad():
                embedding = self.embed(batch.current)
            return reconstruction_losses(self._decode(embedding), batch.current)
        frames = torch.stack([pack(image) for image in self._rolled(batch.previous, batch.current, batch.next)])
        start, ahead = self._drawn(len(batch.current), frames.device)
        row = torch.arange(len(start), device=start.device)
        first, following, last = frames[start, row], frames[start + 1, row], frames[start + ahead, row]
        state, future = self.encoder(torch.cat([first, last])).float().chunk(2)
        with torch.no_grad():
            here, there = self.target(torch.cat([first, following])).float().chunk(2)
            wanted = self.target_changes(there - here)
        latent = self._infer(state, self.changes(future - state))
        predicted = self.forward_model(_normalised(state).detach(), latent).float()  # detached as the authors': the
        prediction = F.mse_loss(predicted, wanted)  # latent action alone teaches the encoder
        told = self._label_error(batch.labelled) if batch.labelled is not None else prediction.new_zeros(())
        return Losses(
            total=prediction + self.config.label_weight * told,
            terms={"prediction": prediction.detach()}
            | ({"labels": told.detach()} if batch.labelled is not None else {}),
        )

    def latent_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Float[Tensor, "b d"]:
        """z_t from x_t and the next frame; it does not depend on x_{t-1}."""
        state, future = self.embed(torch.cat([current, following])).chunk(2)
        return self._infer(state, self.changes(future - state, own=False))

    @torch.no_grad()
    def align(self, demonstrations: Demonstrations) -> None:
        """Learn the z_t of each action."""
        self.table.fit(demonstrations.read(self.latent_action), demonstrations.action)

    def embed(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b e"]:
        """A frame's embedding."""
        embedding: Tensor = self.encoder(pack(image))
        return embedding.float()

    def begin(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> tuple[Tensor]:
        """s_t."""
        return (self.embed(current),)

    def advance(self, state: tuple[Tensor], action: Actions) -> tuple[Tensor]:
        """s_{t+1} under the action's z_t."""
        return (self._advance(state[0], self.table(action)),)

    def embedding(self, state: tuple[Tensor]) -> Float[Tensor, "b e"]:
        """s_t itself, for H@1 and MRR."""
        return state[0]

    def frame(self, state: tuple[Tensor]) -> Float[Tensor, "b c h w"]:
        """s_t, decoded."""
        return self._decode(state[0])

    def predict_with_latent(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        latent: Float[Tensor, "b d"],
    ) -> Float[Tensor, "b c h w"]:
        """s_{t+1} under a latent action, decoded."""
        return self._decode(self._advance(self.embed(current), latent))

    def _drawn(self, count: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Where each sample of a batch begins in its triplet, and how far the inverse model looks ahead from there.

        Two steps ahead lead from x_{t-1} to x_{t+1}. In evaluation all are of one step, from x_t.
        """
        far = torch.zeros(count, dtype=torch.long, device=device)
        if self.training and self.config.ahead == 2:
            far = torch.randint(2, (count,), device=device)
        return 1 - far, 1 + far

    def _rolled(self, *images: Float[Tensor, "b c h w"]) -> tuple[Float[Tensor, "b c h w"], ...]:
        """All images moved alike, by a random shift; in evaluation as they are."""
        if not self.training or not self.config.shift:
            return images
        ((down, right),) = _shifts(1, self.config.shift)
        return tuple(image.roll((down, right), dims=(-2, -1)) for image in images)

    def _rolled_each(self, *images: Float[Tensor, "b c h w"]) -> tuple[Float[Tensor, "b c h w"], ...]:
        """As ``_rolled``, but each triplet by a shift of its own, as labelled ones are."""
        if not self.training or not self.config.label_shift:
            return images
        shifts = _shifts(len(images[0]), self.config.label_shift)
        return tuple(
            torch.stack([one.roll(shift, dims=(-2, -1)) for one, shift in zip(image, shifts, strict=True)])
            for image in images
        )

    def _infer(self, state: Float[Tensor, "b e"], change: Float[Tensor, "b e"]) -> Float[Tensor, "b d"]:
        latent: Tensor = self.inverse_model(state[:, :0], torch.cat([_normalised(state), change], dim=1))
        return latent.float()

    def _advance(self, state: Float[Tensor, "b e"], latent: Float[Tensor, "b d"]) -> Float[Tensor, "b e"]:
        change = self.forward_model(_normalised(state), latent.to(state.dtype)).float()
        return state + self.target_changes.undone(change)

    def _label_error(self, labelled: Demonstrations) -> Float[Tensor, ""]:
        raise NotImplementedError("models of video are given no labels while they learn")

    def _decode(self, embedding: Float[Tensor, "b e"]) -> Float[Tensor, "b c h w"]:
        return unpack(self.decoder(_normalised(embedding))).float()


class LaomWithLabels(Laom):
    """Learns from video and from a few labelled transitions beside each batch of it."""

    supervision: ClassVar[Supervision] = Supervision.FEW

    def __init__(self, config: LaomConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.encoding = ActionEncoding(inputs.actions)
        self.true_action = linear(config.length, self.encoding.width, 0.1)
        left_to_adam(*self.true_action.parameters())

    def phases(self) -> tuple[Phase, ...]:
        """As without labels, but for those beside each batch."""
        return LATENTS_WITH_LABELS, DECODER

    def _label_error(self, labelled: Demonstrations) -> Float[Tensor, ""]:
        """How badly a linear map reads the labelled actions from z_t: cross-entropy, or the squared error."""
        latent = self.latent_action(*self._rolled_each(labelled.previous, labelled.current, labelled.next))
        read: Tensor = self.true_action(latent).float()
        if isinstance(self.encoding.spec, Continuous):
            return F.mse_loss(read, self.encoding(labelled.action))
        return F.cross_entropy(read, labelled.action)


def _shifts(count: int, most: int) -> list[tuple[int, int]]:
    """Down and right, each at most so much either way [px]."""
    drawn = torch.randint(-most, most + 1, (count, 2)).tolist()
    return [(down, right) for down, right in drawn]


def _normalised(embedding: Float[Tensor, "b e"]) -> Float[Tensor, "b e"]:
    """Mean 0 and variance 1 within each embedding, in float32."""
    return F.layer_norm(embedding.float(), embedding.shape[1:])
