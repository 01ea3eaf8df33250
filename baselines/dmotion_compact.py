"""Small and fast networks for DMotion: the same four parts and the same structure, with other layers.

What differs from ``dmotion_paper.py``, and what each difference bought, is measured in decisions 018 to 020:

- Everything runs on 4 x 4 patches of the frame as 48 channels, at 32 x 32 and below: wide convolutions on small maps
  keep the CPU's bfloat16 units busy, narrow ones on large maps wait for memory.
- No normalisation: scaled initial weights and residual connections do without.
- The two encoders cannot know where in the picture they look: their convolutions go round the edges, and the motion
  encoder sums its features instead of flattening them. And phi(a, b) = -phi(b, a): going back undoes going there.
  Without this phi^0 becomes a function of the agent's place, and one demonstration per action is not enough.
- The interaction learner is a U-Net whose output is blended into x_t by a gate per pixel: what does not move is copied.

Frames are *packed*: ``Float[b 48 h/4 w/4]``, channels-last in memory.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor, nn

from baselines.layers import OUTPUT_GAIN, WIDTHS, MotionTrunk, block, conv, left_to_adam, up
from baselines.patches import CHANNELS, from_patches, pack, patches, unpack
from baselines.unet import UNet, UNetConfig

__all__ = ["Decoder", "ImageEncoder", "InteractionLearner", "MotionEncoder", "pack", "unpack"]

MAP_PIXEL = 2  # the side of a map's pixel [px of the frame]
LARGEST_SHIFT = 0.6  # of half the map: |t| stays below it
MOTION_RATE = 0.3  # the motion's last layer learns at this share of the rate: it is what oscillates first


class ImageEncoder(nn.Module):
    """Encodes a packed frame into n maps of half its side (64 x 64 for 128 pixels).

    The branch at half the size widens the receptive field: the agent before and after a move must overlap on the maps.
    """

    def __init__(self, maps: int) -> None:
        super().__init__()
        c, w, _ = WIDTHS
        self.stem = block(CHANNELS, c, 1)
        self.context = nn.Sequential(block(c, w, stride=2, edges=False), block(w, w, edges=False), up(w, c))
        self.head = nn.Sequential(block(c, c, edges=False), conv(c, 4 * maps, 1, gain=OUTPUT_GAIN))

    def forward(self, packed: Float[Tensor, "b p hp wp"], count: int | None = None) -> Float[Tensor, "b k hm wm"]:
        """The maps; only the first ``count`` of them, if that is given."""
        features = self.stem(packed)
        features = features + self.context(features)
        packed = self.head(features)
        return from_patches(packed if count is None else packed[:, : 4 * count], 2)


class MotionEncoder(MotionTrunk):
    """Infers the motion of each map from two packed frames.

    Args:
        maps: n.
        identity: The motion that moves nothing.
        reversible: Whether going back is the negative of going there, as for transformers; then it is bounded, too.
    """

    identity: Tensor

    def __init__(self, maps: int, identity: Float[Tensor, " d"], reversible: bool = True) -> None:
        super().__init__(frames=2)
        self.maps, self.reversible = maps, reversible
        self.motion = nn.Linear(self.length, maps * len(identity), bias=False)
        nn.init.normal_(self.motion.weight, std=0.05)
        left_to_adam(self.motion.weight, rate=MOTION_RATE)
        self.register_buffer("identity", identity.clone())

    def forward(
        self, current: Float[Tensor, "b p hp wp"], following: Float[Tensor, "b p hp wp"]
    ) -> Float[Tensor, "b k d"]:
        if not self.reversible:
            return self.identity + self._each_map(self.summarise([current, following]).float())
        there_and_back = torch.cat([current, following]), torch.cat([following, current])
        going, returning = self.summarise(there_and_back).float().chunk(2)
        return self.identity + LARGEST_SHIFT * torch.tanh(self._each_map(going - returning))

    def _each_map(self, features: Float[Tensor, "b f"]) -> Float[Tensor, "b k d"]:
        motion: Tensor = rearrange(self.motion(features), "b (k d) -> b k d", k=self.maps)
        return motion.float()


class Decoder(nn.Module):
    """Decodes the moved maps into the packed next frame."""

    def __init__(self, maps: int) -> None:
        super().__init__()
        c = WIDTHS[0]
        self.layers = nn.Sequential(block(4 * maps, c), conv(c, CHANNELS, 1, gain=OUTPUT_GAIN))

    def forward(self, maps: Float[Tensor, "b k hm wm"]) -> Float[Tensor, "b p hp wp"]:
        packed: Tensor = self.layers(patches(maps, 2))
        return packed


class InteractionLearner(UNet):
    """A U-Net over the packed frames; the agents' moved maps are added at three depths.

    Args:
        frames: 2 as in the paper; 1 leaves x_{t-1} out.
        agent_entries: 3, or 1 for the input alone.
        config: As for ``UNet``.
        agents: Maps of agents.
    """

    def __init__(
        self,
        frames: int = 2,
        agent_entries: int = 3,
        *,
        config: UNetConfig | None = None,
        agents: int = 1,
    ) -> None:
        super().__init__(frames, config)
        c, w, d = self.widths
        self.agent_entries = agent_entries
        self.agent_in = conv(4 * agents, c, 1)
        if agent_entries == 3:
            self.agent_1, self.agent_2 = conv(4 * agents, w, stride=2), conv(4 * agents, d, 1)

    def forward(
        self,
        frames: Sequence[Float[Tensor, "m p hp wp"]],
        agent: Float[Tensor, "b a hm wm"],
        *,
        parent: Int[Tensor, " b"] | None = None,
        current: Float[Tensor, "b p hp wp"] | None = None,
    ) -> Float[Tensor, "b p hp wp"]:
        agent = patches(agent, 2)
        deeper = () if self.agent_entries == 1 else (self.agent_1(agent), self.agent_2(F.avg_pool2d(agent, 4)))
        return self.next_frame(frames, self.agent_in(agent), *deeper, parent=parent, current=current)
