"""LAPO (Schmidt, Jiang 2024): latent actions by an inverse and a forward model, through a vector-quantised bottleneck.

The inverse model infers z_t from (x_{t-1}, x_t, x_{t+1}); z_t is quantised; the forward model predicts x_{t+1} from
(x_{t-1}, x_t, z_t). The loss is the squared error of x_{t+1} plus the commitment of z_t to its codes. What the
past cannot tell the forward model, z_t must; the codebooks limit how much that may be.

Its sizes are the authors': two codebooks of 64 codes of length 16, four latents each. Settled so (docs/models):
the inverse and the forward model are of the shared backbone; codes that nothing chooses are put where something is
(Jukebox's random restarts, Dhariwal et al. 2020); and the alignment, for which LAPO trains a decoder of z into actions
for a policy, goes the other way: from an action to z_t by ``ActionToLatent``, quantised when used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.distributed as dist
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor, nn

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
class LapoConfig(UNetConfig):
    """The authors' choices, except for the decay, and those of the network that draws.

    Their frames are in [-0.5, 0.5], where squared errors are a quarter of ours: there 0.05 weighs as 0.2 does here.

    Attributes:
        codebooks: Number of codebooks.
        latents: Discrete latents that each codebook gives a code.
        codes: Codes in a codebook.
        length: Of a code.
        commitment: Weight of the distance between z_t and its codes.
        decay: Of the running means that the codes are; the authors' 0.999 is for 50,000 steps.
        restart: A code whose running count is below this is put on a part of the batch, drawn at random; so the first
            batch places them. Without it 7 of 128 codes were in use (docs/experiments/baseline-repairs.md).
    """

    codebooks: int = 2
    latents: int = 4
    codes: int = 64
    length: int = 16
    commitment: float = 0.05
    decay: float = 0.99
    restart: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.codebooks, self.latents, self.codes, self.length) < 1:
            raise InvalidSetting("codebooks, latents, codes and length must be 1 or more.")
        if not 0 <= self.decay < 1 or self.commitment < 0 or self.restart <= 0:
            raise InvalidSetting("decay must be in [0, 1), commitment 0 or more, restart above 0.")

    @property
    def action_length(self) -> int:
        """Numbers in a latent action."""
        return self.codebooks * self.latents * self.length


class VectorQuantizer(nn.Module):
    """Replaces parts of a vector by their nearest codes, which are running means (van den Oord 2017, appendix A.1)."""

    codes: Tensor
    counts: Tensor
    sums: Tensor

    def __init__(self, config: LapoConfig) -> None:
        super().__init__()
        self.config = config
        reach = 5 / config.codes
        codes = torch.empty(config.codebooks, config.codes, config.length).uniform_(-reach, reach)
        self.register_buffer("codes", codes)
        self.register_buffer("counts", torch.zeros(config.codebooks, config.codes))
        self.register_buffer("sums", codes.clone())

    def forward(self, latent: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, ""]]:
        """The quantised vector, through which gradients pass straight to ``latent``, and the commitment loss."""
        parts = rearrange(latent.float(), "b (n h d) -> n (b h) d", n=self.config.codebooks, d=self.config.length)
        with torch.autocast(latent.device.type, enabled=False):  # distances and running means need all digits
            chosen = self.nearest(parts.detach())
            quantised = torch.gather(self.codes, 1, chosen[..., None].expand(parts.shape))
            if self.training:
                self._follow(parts.detach(), chosen)
        commitment = self.config.commitment * F.mse_loss(parts, quantised)
        straight = parts + (quantised - parts).detach()
        return rearrange(straight, "n (b h) d -> b (n h d)", b=len(latent)), commitment

    def nearest(self, parts: Float[Tensor, "n m d"]) -> Int[Tensor, "n m"]:
        """The number of the code nearest to each part, in the part's own codebook."""
        return torch.cdist(parts, self.codes).argmin(-1)

    @torch.no_grad()
    def _follow(self, parts: Float[Tensor, "n m d"], chosen: Int[Tensor, "n m"]) -> None:
        """Update each code as the running mean of the parts that chose it; move an unused code onto some part."""
        one_hot = F.one_hot(chosen, self.config.codes).to(parts.dtype)
        counts, sums = one_hot.sum(1), one_hot.mT @ parts
        if dist.is_initialized():  # of the whole batch, of which each process has a part
            dist.all_reduce(counts)
            dist.all_reduce(sums)
        self.counts.lerp_(counts, 1 - self.config.decay)
        self.sums.lerp_(sums, 1 - self.config.decay)
        drawn = parts[:, torch.randint(parts.shape[1], (self.config.codes,), device=parts.device)]
        idle = self.counts < self.config.restart
        self.sums.copy_(torch.where(idle[..., None], drawn, self.sums))
        self.counts.masked_fill_(idle, 1.0)
        self.codes.copy_(self.sums / self.counts[..., None])


class Lapo(TwoFrameModel[LapoConfig]):
    """Learns from video alone; a few demonstrations tell it afterwards which latent action each action is."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = "Schmidt, Jiang: Learning to Act without Actions, ICLR 2024"
    Config: ClassVar[type] = LapoConfig

    def __init__(self, config: LapoConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        check_size("LAPO", inputs)
        self.trunk = MotionTrunk(frames=3)
        self.latent = linear(MotionTrunk.length, config.action_length)
        self.quantizer = VectorQuantizer(config)
        self.forward_model = CodedUNet(config.action_length, config=config)
        self.table = ActionToLatent(inputs.actions, config.action_length)

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """DMotion's settings."""
        return compact_recipe(preset, passes=1.5)

    def losses(self, batch: TripletBatch) -> Losses:
        """Squared error of x_{t+1} in [-1, 1] units, and the commitment."""
        previous, current, following = pack(batch.previous), pack(batch.current), pack(batch.next)
        code, commitment = self.quantizer(self._infer(previous, current, following))
        predicted = self.forward_model([previous, current], code.to(current.dtype))
        each = squared_error(predicted, following)
        prediction = each.mean()
        return Losses(
            total=prediction + commitment,
            terms={"prediction": prediction.detach(), "commitment": commitment.detach()},
            per_triplet=each.detach(),
        )

    def latent_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Float[Tensor, "b d"]:
        """z_t before quantisation."""
        return self._infer(pack(previous), pack(current), pack(following)).float()

    @property
    def codebook_sizes(self) -> tuple[int, ...]:
        """Codes in each codebook."""
        return (self.config.codes,) * self.config.codebooks

    def chosen_codes(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Int[Tensor, "b n m"]:
        """The codes nearest to z_t, as many of each codebook as it gives latents."""
        latent, config = self.latent_action(previous, current, following), self.config
        parts = rearrange(latent, "b (n h d) -> n (b h) d", n=config.codebooks, d=config.length)
        return rearrange(self.quantizer.nearest(parts), "n (b h) -> b n h", b=len(latent))

    @torch.no_grad()
    def align(self, demonstrations: Demonstrations) -> None:
        """Learn the z_t of each action."""
        self.table.fit(demonstrations.read(self.latent_action), demonstrations.action)

    def _drawn(self, previous: Tensor, current: Tensor, parent: Tensor | None, latent: Tensor) -> Packed:
        frames, last = [previous, current], rows_of(current, parent)
        code, _ = self.quantizer(latent)
        return last, self.forward_model(frames, code.to(current.dtype), parent=parent, current=last)

    def _infer(self, previous: Tensor, current: Tensor, following: Tensor) -> Float[Tensor, "b d"]:
        latent: Tensor = self.latent(self.trunk.summarise([previous, current, following]))
        return latent
