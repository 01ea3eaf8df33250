"""DMotion's networks as published: section III-D of the paper.

``docs/models`` says how everything that the paper leaves open is settled.

Every convolution is followed by batch normalisation (gain 1) and a LeakyReLU of slope 0.2, and has no bias of its own,
but for the last one of the image encoder, of the decoder and of the interaction learner. 2,684,142 parameters with
eight maps, six-parameter motions and three entries of the agent's map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

SLOPE = 0.2
MAP_SIZE = 64
SMALL_MAP = 4
"""Side of the maps that motions are read from; of at least so many pixels where the frame's side is no power of two."""


def pack(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Return the frames unchanged: these networks do not pack them."""
    return image


def unpack(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Return the frames unchanged, the inverse of ``pack``."""
    return image


def _conv(inputs: int, outputs: int, kernel: int = 5, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.LeakyReLU(SLOPE),
    )


def _deconv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.ConvTranspose2d(inputs, outputs, 5, stride, 2, output_padding=stride - 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.LeakyReLU(SLOPE),
    )


class ImageEncoder(nn.Module):
    """Seven convolutions from the frame, enlarged to 256 pixels, to n maps of 64 x 64."""

    def __init__(self, maps: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Upsample(size=4 * MAP_SIZE, mode="nearest"),
            _conv(3, 32, stride=2),
            _conv(32, 32),
            _conv(32, 64, stride=2),
            _conv(64, 64),
            _conv(64, 64),
            _conv(64, 32),
            nn.Conv2d(32, maps, 5, padding=2),
        )

    def forward(self, image: Float[Tensor, "b 3 h w"], count: int | None = None) -> Float[Tensor, "b k hm wm"]:
        """The maps; only the first ``count`` of them, if that is given."""
        maps: Tensor = self.layers(image)
        return maps[:, :count]


class MotionEncoder(nn.Module):
    """Seven convolutions over the pair; each of the n small maps that come out has two layers of its own.

    Args:
        maps: n.
        identity: The motion that moves nothing; the encoder gives it before training.
        reversible: Not used here.
        side: Of the frames [px]. Five of the convolutions have stride 2 at the paper's 128 and four at 64, as in the
            published code; so four-by-four maps come out of both.
    """

    def __init__(
        self, maps: int, identity: Float[Tensor, " d"], reversible: bool = True, *, side: int = 2 * MAP_SIZE
    ) -> None:
        super().__init__()
        widths = (6, 16, 16, 32, 32, 64)
        halvings = min(len(widths) - 1, (side // SMALL_MAP).bit_length() - 1)
        self.convolutions = nn.Sequential(
            *(
                _conv(before, after, stride=2 if place < halvings else 1)
                for place, (before, after) in enumerate(pairwise(widths))
            ),
            _conv(64, 64),
            _conv(64, maps),
        )
        small = math.ceil(side / 2**halvings)
        self.heads = nn.ModuleList(_motion_head(small * small, 64, identity) for _ in range(maps))

    def forward(self, current: Float[Tensor, "b 3 h w"], following: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b k d"]:
        small = self.convolutions(torch.cat([current, following], dim=1))
        features = rearrange(small, "b k i j -> k b (i j)")
        return torch.stack([head(part) for head, part in zip(self.heads, features, strict=True)], dim=1).float()


def _motion_head(features: int, hidden: int, identity: Float[Tensor, " d"]) -> nn.Sequential:
    last = nn.Linear(hidden, len(identity))
    nn.init.zeros_(last.weight)
    with torch.no_grad():
        last.bias.copy_(identity)
    return nn.Sequential(nn.Linear(features, hidden), nn.LeakyReLU(SLOPE), last)


class Decoder(nn.Module):
    """Five convolutions from the moved maps to the next frame, of ``side`` pixels."""

    def __init__(self, maps: int, *, side: int = 2 * MAP_SIZE) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            _conv(maps, 32, 9),
            _conv(32, 32, 9),
            nn.Upsample(size=side, mode="nearest"),
            _conv(32, 32),
            _conv(32, 32),
            nn.Conv2d(32, 3, 5, padding=2),
            nn.Tanh(),
        )

    def forward(self, maps: Float[Tensor, "b k hm wm"]) -> Float[Tensor, "b 3 h w"]:
        image: Tensor = self.layers(maps)
        return image


class InteractionLearner(nn.Module):
    """Five convolutions, five deconvolutions and a last convolution, with the agent's map at three places.

    Args:
        frames: 2 as in the paper; 1 leaves x_{t-1} out.
        agent_entries: 3 (the input, after the first convolution, before the first deconvolution), or 1:
            the input alone.
        agents: Maps of agents; 1 in the paper.
    """

    def __init__(self, frames: int = 2, agent_entries: int = 3, *, agents: int = 1) -> None:
        super().__init__()
        self.inner = agent_entries == 3
        extra = agents if self.inner else 0
        self.first = _conv(3 * frames + agents, 32, stride=2)
        self.encoder = nn.Sequential(_conv(32 + extra, 64, stride=2), _conv(64, 128), _conv(128, 128), _conv(128, 128))
        self.decoder = nn.Sequential(
            _deconv(128 + extra, 128),
            _deconv(128, 64, 2),
            _deconv(64, 64, 2),
            _deconv(64, 64),
            _deconv(64, 32),
        )
        self.last = nn.Sequential(nn.Conv2d(32, 3, 3, padding=1), nn.Tanh())

    def forward(
        self, frames: Sequence[Float[Tensor, "b 3 h w"]], agent: Float[Tensor, "b a hm wm"]
    ) -> Float[Tensor, "b 3 h w"]:
        features = self.first(self._with(torch.cat(list(frames), dim=1), agent, always=True))
        features = self.encoder(self._with(features, agent))
        image: Tensor = self.last(self.decoder(self._with(features, agent)))
        return image

    def _with(self, features: Tensor, agent: Tensor, *, always: bool = False) -> Tensor:
        if not (self.inner or always):
            return features
        return torch.cat([features, F.interpolate(agent, features.shape[-2:]).to(features.dtype)], dim=1)
