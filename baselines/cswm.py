"""C-SWM (Kipf, van der Pol, Welling 2020): contrastive learning of structured world models.

A convolutional extractor turns the frames into K maps, one MLP for all turns each map into a slot's state, and a fully
connected graph network predicts the change of all slots under an action. There is no picture in its loss: the predicted
state is to lie near the true next one, other states are to lie at least a hinge away (its section 2.3):

    L = d(z_t + T(z_t, a_t), z_{t+1}) + max(0, gamma - d(z_t, z~))
    d(z, z') = mean over slots of |z - z'|^2 / (2 sigma^2)

where z~ is another state of the batch, as in the authors' program. Half of them are of the same episode, as Biza, van
der Pol and Kipf found necessary (The Impact of Negative Sampling on Contrastive Structured World Models, 2021): what
stands still tells episodes apart, so negatives of other episodes alone teach nothing of what moves. Then all that is
frozen and a decoder of the states is trained on video; the prediction decodes z_t + T(z_t, a_t).

Settled so (docs/models): two frames go in, as the paper says; the action is copied to every slot. The extractor
and the decoder are of the shared backbone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float, Int
from torch import Tensor, nn

from baselines.layers import (
    SLOPE,
    WIDTHS,
    FrameDecoder,
    block,
    check_size,
    conv,
    left_to_adam,
    linear,
    reconstruction_losses,
)
from baselines.patches import CHANNELS, pack, unpack
from baselines.recipe import compact_recipe
from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, Phase, TrainingConfig, TripletBatch
from dmotion_bench.specs import Preset, Supervision

CONTRAST = Phase(name="contrast", fraction=0.6, needs_actions=True, together=4)
CONTRAST_RATE = 1 / 3  # of the recipe's; with Adam, as the authors
DECODER = Phase(name="decoder", fraction=0.4)


@dataclass(frozen=True, kw_only=True)
class ContrastiveConfig:
    """The original's choices, except for the number of slots; a slot's length is that for Atari games.

    Attributes:
        slots: K, at least as many as there are objects.
        features: Length of a slot's state.
        frames: That a state is made of: 2, the last two, or 1, the present one.
        hidden: Width of the MLPs and of the graph network.
        sigma: Width of the energy.
        hinge: gamma, how far states are pushed apart.
        near: Share of the negatives that are of the same episode.
    """

    slots: int = 6
    features: int = 4
    frames: int = 2
    hidden: int = 512
    sigma: float = 0.5
    hinge: float = 1.0
    near: float = 0.5

    def __post_init__(self) -> None:
        if min(self.slots, self.features, self.hidden) < 1 or self.sigma <= 0 or self.hinge <= 0:
            raise InvalidSetting("slots, features and hidden must be 1 or more, sigma and hinge above 0.")
        if self.frames not in (1, 2):
            raise InvalidSetting(f"frames is {self.frames}; a state is made of 1 or 2.")
        if not 0 <= self.near <= 1:
            raise InvalidSetting(f"near is {self.near}; it is a share from 0 to 1.")


class SlotEncoder(nn.Module):
    """Encodes packed frames, one or two, into the states of K slots.

    As the authors' for Atari games, but without batch normalisation: a convolution with a wide stride to small maps
    (10 x 10 there, 8 x 8 here), their values between 0 and 1. The MLP's initial weights keep the scale, so that
    different frames get different states from the start: the hinge's gradient vanishes where all states are one.
    """

    def __init__(self, config: ContrastiveConfig, inputs: ModelInputs) -> None:
        super().__init__()
        c, w, _ = WIDTHS
        place = (inputs.height // 16) * (inputs.width // 16)
        self.extractor = nn.Sequential(
            block(config.frames * CHANNELS, c, 1),
            nn.Conv2d(c, w, 4, 4),
            nn.LeakyReLU(SLOPE),
            conv(w, config.slots, 1),
            nn.Sigmoid(),
        )
        self.state = _mlp(place, config.hidden, config.features)

    def forward(self, packed: Float[Tensor, "b p hp wp"]) -> Float[Tensor, "b k d"]:
        state: Tensor = self.state(rearrange(self.extractor(packed), "b k h w -> b k (h w)"))
        return state.float()


class GraphTransition(nn.Module):
    """Predicts how an action changes all slots: each pair of slots exchanges messages, which each slot adds up."""

    def __init__(self, config: ContrastiveConfig, actions: ActionSpec | None) -> None:
        super().__init__()
        self.encoding = ActionEncoding(actions)
        self.edge = _mlp(2 * config.features, config.hidden, config.hidden)
        self.node = _mlp(
            config.features + config.hidden + self.encoding.width, config.hidden, config.features, gain=0.1
        )

    def forward(self, state: Float[Tensor, "b k d"], action: Actions) -> Float[Tensor, "b k d"]:
        slots = state.shape[1]
        place = torch.arange(slots * (slots - 1), device=state.device)  # of each pair, by receiver and sender
        receiver, other = place // (slots - 1), place % (slots - 1)
        sender = other + (other >= receiver)
        messages = self.edge(torch.cat([state[:, receiver], state[:, sender]], dim=-1))
        received = rearrange(messages, "b (k s) d -> b k s d", k=slots).sum(2)
        chosen = self.told(action, slots).to(state.dtype)
        change: Tensor = self.node(torch.cat([state, chosen, received], dim=-1))
        return change.float()

    def told(self, action: Actions, slots: int) -> Float[Tensor, "b k a"]:
        """What each slot is told of the action: all of it."""
        told: Tensor = repeat(self.encoding(action), "b a -> b k a", k=slots)
        return told


def _mlp(inputs: int, hidden: int, outputs: int, gain: float = 1.0) -> nn.Sequential:
    return nn.Sequential(
        linear(inputs, hidden, 2**0.5),
        nn.ReLU(),
        linear(hidden, hidden, 2**0.5),
        nn.LayerNorm(hidden),
        nn.ReLU(),
        linear(hidden, outputs, gain),
    )


class ContrastiveWorldModel(ForwardModel[ContrastiveConfig]):
    """Predicts the states of slots; a decoder that is trained afterwards draws them as frames."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "Kipf, van der Pol, Welling: Contrastive Learning of Structured World Models, ICLR 2020"
    Config: ClassVar[type] = ContrastiveConfig

    def __init__(self, config: ContrastiveConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("C-SWM", inputs)
        self.encoder = SlotEncoder(config, inputs)
        self.transition = GraphTransition(config, inputs.actions)
        left_to_adam(*self.encoder.parameters(), *self.transition.parameters(), rate=CONTRAST_RATE)
        self.decoder = FrameDecoder(inputs, config.slots * config.features, hidden=512)
        self.phase = CONTRAST

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """As DMotion's; what the contrast trains is left to Adam, at 1e-3 (the original's: 5e-4, batches of 1024)."""
        return compact_recipe(preset, passes=4)

    def phases(self) -> tuple[Phase, ...]:
        """States and their dynamics first, from what is labelled; then the decoder, from all video."""
        return CONTRAST, DECODER

    def enter(self, phase: Phase) -> None:
        """Freeze the parameters that the other phase trains."""
        self.phase = phase
        self.encoder.requires_grad_(phase == CONTRAST)
        self.transition.requires_grad_(phase == CONTRAST)
        self.decoder.requires_grad_(phase == DECODER)

    def losses(self, batch: TripletBatch) -> Losses:
        """The contrastive loss in the first phase, the decoder's squared error in the second."""
        if self.phase == DECODER:
            with torch.no_grad():
                state = self.states(batch.previous, batch.current)
            return reconstruction_losses(self._decode(state), batch.current)
        assert batch.action is not None, "the loop gives labelled triplets in a phase that needs actions"
        state, following = self.states(
            torch.cat([batch.previous, batch.current]), torch.cat([batch.current, batch.next])
        ).chunk(2)
        attraction = self.energy(state + self.transition(state, batch.action), following).mean()
        repulsion = F.relu(self.config.hinge - self.energy(state, state[self.negatives(batch)])).mean()
        return Losses(
            total=attraction + repulsion,
            terms={"attraction": attraction.detach(), "repulsion": repulsion.detach()},
        )

    def negatives(self, batch: TripletBatch) -> Int[Tensor, " b"]:
        """Another state of the batch for each state: a share of the same episode, the rest of other episodes."""
        count, device = len(batch.current), batch.current.device
        near = torch.rand(count, 1, device=device) < self.config.near
        wanted = torch.zeros_like(near) if batch.episode is None else (batch.episode[:, None] == batch.episode) == near
        drawn = torch.rand(count, count, device=device)
        return torch.where(wanted, drawn, drawn - 1).fill_diagonal_(-2.0).argmax(1)

    def energy(self, state: Float[Tensor, "b k d"], other: Float[Tensor, "b k d"]) -> Float[Tensor, " b"]:
        """d(z, z'): the distance of two states."""
        return (state - other).square().sum(2).mean(1) * (0.5 / self.config.sigma**2)

    def states(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k d"]:
        """z_t."""
        seen = (previous, current)[-self.config.frames :]
        state: Tensor = self.encoder(torch.cat([pack(one) for one in seen], dim=1))
        return state

    def begin(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b k d"]]:
        """z_t."""
        return (self.states(previous, current),)

    def advance(self, state: tuple[Float[Tensor, "b k d"]], action: Actions) -> tuple[Float[Tensor, "b k d"]]:
        """z_t + T(z_t, a_t)."""
        (slots,) = state
        return (slots + self.transition(slots, action),)

    def embedding(self, state: tuple[Float[Tensor, "b k d"]]) -> Float[Tensor, "b k d"]:
        """The slots, for H@1 and MRR."""
        return state[0]

    def frame(self, state: tuple[Float[Tensor, "b k d"]]) -> Float[Tensor, "b c h w"]:
        """The states, decoded."""
        return self._decode(state[0])

    def _decode(self, state: Float[Tensor, "b k d"]) -> Float[Tensor, "b c h w"]:
        return unpack(self.decoder(rearrange(state, "b k d -> b (k d)"))).float()
