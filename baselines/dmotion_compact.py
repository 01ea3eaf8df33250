"""DMotion's networks made small and fast: the same four parts, the same inductive structure, other layers.

What differs from ``dmotion_paper.py``, and what each difference bought, is measured in DECISIONS.md:

- Everything runs on 4 x 4 patches of the frame as 48 channels, at 32 x 32 and below: wide convolutions on small maps
  keep the CPU's bfloat16 units busy, narrow ones on large maps wait for memory.
- No normalisation: scaled initial weights and residual connections do without.
- The motion encoder sums its features over the picture instead of flattening them. A sum knows what moved and how, not
  where, so phi^0 cannot become a function of the agent's place, and one demonstration per action is enough.
- The interaction learner is a U-Net whose output is blended into x_t by a gate per pixel: what does not move is copied.

Frames are *packed*: ``Float[b 48 h/4 w/4]``, channels-last in memory.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

SLOPE = 0.2
PATCH = 4
WIDTHS = (32, 64, 128)
LARGEST_SHIFT = 0.6  # of half the map: |t| stays below it
MOTION_RATE = 0.3  # the motion's last layer learns at this share of the rate: it is what oscillates first


def pack(image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b p hp wp"]:
    """4 x 4 patches as channels."""
    if torch.is_autocast_enabled(image.device.type):
        image = image.to(torch.get_autocast_dtype(image.device.type))
    return _channels_last(image, "b c (h p) (w q) -> b h w (c p q)", PATCH)


def unpack(packed: Float[Tensor, "b p hp wp"]) -> Float[Tensor, "b c h w"]:
    """Channels as 4 x 4 patches."""
    return rearrange(packed, "b (c p q) h w -> b c (h p) (w q)", p=PATCH, q=PATCH)


def _channels_last(image: Tensor, pattern: str, patch: int) -> Tensor:
    """Space to depth in one copy; ``pixel_unshuffle`` and a convolution that wants another order cost two."""
    return rearrange(image, pattern, p=patch, q=patch).contiguous().permute(0, 3, 1, 2)


def _map_patches(maps: Float[Tensor, "b k h w"]) -> Float[Tensor, "b k4 h2 w2"]:
    return _channels_last(maps, "b k (h p) (w q) -> b h w (k p q)", 2)


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, gain: float = 1.0) -> nn.Conv2d:
    """A convolution whose output has the variance of its input times gain squared."""
    layer = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2)
    nn.init.normal_(layer.weight, std=gain * (inputs * kernel * kernel) ** -0.5)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


def _block(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    gain = nn.init.calculate_gain("leaky_relu", SLOPE)
    return nn.Sequential(_conv(inputs, outputs, kernel, stride, gain), nn.LeakyReLU(SLOPE, inplace=True))


def _up(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    """Twice the size; each input pixel makes a 2 x 2 patch."""
    layer = nn.ConvTranspose2d(inputs, outputs, 2, 2)
    nn.init.normal_(layer.weight, std=0.7 * inputs**-0.5)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


class ImageEncoder(nn.Module):
    """A packed frame to n maps of half its side (64 x 64 for 128 pixels)."""

    def __init__(self, maps: int) -> None:
        super().__init__()
        c, w, _ = WIDTHS
        self.stem = nn.Sequential(_block(3 * PATCH**2, c, 1), _block(c, c))
        self.context = nn.Sequential(_block(c, w, stride=2), _block(w, w), _up(w, c))
        self.head = nn.Sequential(_block(c, c), _conv(c, 4 * maps, 1, gain=0.7))

    def forward(self, packed: Float[Tensor, "b p hp wp"]) -> Float[Tensor, "b k hm wm"]:
        features = self.stem(packed)
        features = features + self.context(features)
        maps: Tensor = rearrange(self.head(features), "b (k p q) h w -> b k (h p) (w q)", p=2, q=2)
        return maps


class MotionEncoder(nn.Module):
    """Two packed frames to the motion of each map, bounded around the identity.

    Args:
        maps: n.
        identity: The motion that moves nothing.
    """

    identity: Tensor

    def __init__(self, maps: int, identity: Float[Tensor, " d"]) -> None:
        super().__init__()
        c, w, _ = WIDTHS
        self.maps = maps
        self.convolutions = nn.Sequential(
            _block(6 * PATCH**2, c, 1),
            _block(c, w, stride=2),
            _block(w, w),
            _block(w, w, stride=2),
            _block(w, w),
        )
        self.hidden = nn.Sequential(nn.Linear(w, 128), nn.LeakyReLU(SLOPE))
        self.motion = nn.Linear(128, maps * len(identity))
        nn.init.normal_(self.motion.weight, std=0.01)
        nn.init.zeros_(self.motion.bias)
        for parameter in self.motion.parameters():
            parameter.rate_factor = MOTION_RATE  # type: ignore[attr-defined]
        self.register_buffer("identity", identity.clone())

    def forward(
        self, current: Float[Tensor, "b p hp wp"], following: Float[Tensor, "b p hp wp"]
    ) -> Float[Tensor, "b k d"]:
        features = self.convolutions(torch.cat([current, following], dim=1)).sum((2, 3)) * 0.1
        motion = rearrange(self.motion(self.hidden(features)), "b (k d) -> b k d", k=self.maps)
        bounded: Tensor = self.identity + LARGEST_SHIFT * torch.tanh(motion.float())
        return bounded


class Decoder(nn.Module):
    """The moved maps to the packed next frame."""

    def __init__(self, maps: int) -> None:
        super().__init__()
        c = WIDTHS[0]
        self.layers = nn.Sequential(_block(4 * maps, c), _block(c, c), _conv(c, 3 * PATCH**2, 1, gain=0.7))

    def forward(self, maps: Float[Tensor, "b k hm wm"]) -> Float[Tensor, "b p hp wp"]:
        packed: Tensor = self.layers(_map_patches(maps))
        return packed


class InteractionLearner(nn.Module):
    """A U-Net over the packed frames; the agent's moved map is added at three depths.

    Args:
        frames: 2 as in the paper; 1 leaves x_{t-1} out.
        agent_entries: 3, or 1 for the input alone.
    """

    def __init__(self, frames: int = 2, agent_entries: int = 3) -> None:
        super().__init__()
        c, w, d = WIDTHS
        channels = 3 * PATCH**2
        self.agent_entries = agent_entries
        self.frames_in, self.agent_in = _conv(channels * frames, c, 1), _conv(4, c, 1)
        self.level0 = _block(c, c)
        self.down1, self.level1 = _conv(c, w, stride=2), _block(w, w)
        self.down2 = _block(w, d, stride=2)
        self.middle = nn.Sequential(_block(d, d), _block(d, d))
        self.up1, self.merge1 = _up(d, w), _block(w, w)
        self.up0, self.merge0 = _up(w, c), _block(c, c)
        self.painting = _conv(c, channels, 1, gain=0.7)
        self.gate = _conv(c, PATCH**2, 1, gain=0.7)
        if agent_entries == 3:
            self.agent_1, self.agent_2 = _conv(4, w, stride=2), _conv(4, d, 1)

    def forward(
        self, packed: Float[Tensor, "b f hp wp"], agent: Float[Tensor, "b 1 hm wm"]
    ) -> Float[Tensor, "b p hp wp"]:
        agent = _map_patches(agent)
        level0 = self.level0(F.leaky_relu(self.frames_in(packed) + self.agent_in(agent), SLOPE))
        inner = self.down1(level0)
        if self.agent_entries == 3:
            inner = inner + self.agent_1(agent)
        level1 = self.level1(F.leaky_relu(inner, SLOPE))
        level2 = self.down2(level1)
        deepest = level2 + self.agent_2(F.avg_pool2d(agent, 4)) if self.agent_entries == 3 else level2
        level2 = level2 + self.middle(deepest)
        level1 = level1 + self.merge1(level1 + self.up1(level2))
        level0 = self.merge0(level0 + self.up0(level1))
        current = packed[:, -3 * PATCH**2 :]
        gate = torch.sigmoid(self.gate(level0) - 1).repeat(1, 3, 1, 1)  # one gate per pixel, for its three colours
        blended: Tensor = current + gate * (self.painting(level0) - current)
        return blended
