"""The U-Net that draws the next frame, in six of the models, and what they may choose of it.

It blends what it paints into x_t by a gate, and can carry pixels of x_t along by a flow: so it need not paint anew what
stays or what only moves. Frames are *packed*, as in ``layers.py``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor, nn

from baselines.layers import SLOPE, WIDTHS, block, conv, linear, output, over_frames, up
from baselines.patches import CHANNELS, PATCH, patches, rows_of, unpack
from dmotion_bench.errors import InvalidSetting

MIDDLE_BLOCKS = 3
OPENNESS = -1.0  # of the gate before training: it lets in a quarter of what is new
LARGEST_FLOW = 20.0  # [px]: about two steps of an agent


def warped(image: Float[Tensor, "b c h w"], flow: Float[Tensor, "b 2 y x"]) -> Float[Tensor, "b c h w"]:
    """Warp an image: read each pixel where the flow points; the border pixels continue beyond the edges.

    Args:
        image: In float32.
        flow: From each pixel to the one it is read from, (right, down) [px]; of any size, interpolated to the image's.
    """
    height, width = image.shape[2:]
    flow = F.interpolate(flow.contiguous(), size=(height, width), mode="bilinear", align_corners=False)
    down = torch.arange(height, device=image.device)[:, None] + 0.5
    right = torch.arange(width, device=image.device)[None, :] + 0.5
    places = torch.stack([(right + flow[:, 0]) * (2 / width) - 1, (down + flow[:, 1]) * (2 / height) - 1], dim=-1)
    return F.grid_sample(image.contiguous(), places, padding_mode="border", align_corners=False)


@dataclass(frozen=True, kw_only=True)
class UNetConfig:
    """What models whose frames a ``UNet`` draws may choose of it.

    Attributes:
        warp: Whether it can carry what moves, by a flow, instead of painting it anew.
        gate_floor: The least share of what it paints that is let in anywhere. Above 0 for video of which little moves:
            a gate that closed everywhere would learn nothing more.
        width: Times as many channels as usual.
    """

    warp: bool = False
    gate_floor: float = 0.0
    width: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.gate_floor < 1:
            raise InvalidSetting(f"gate_floor is {self.gate_floor}; it must be at least 0 and below 1.")
        if self.width < 1:
            raise InvalidSetting(f"width is {self.width}; it must be 1 or more.")


class UNet(nn.Module):
    """Predicts the next packed frame from the last ones; other inputs are added to the features at three depths.

    The output is blended into x_t by a gate per pixel: what does not move is copied. It can also be painted over what
    a flow, which a second gate lets in, has taken along from x_t. The floor of the first gate matters where little of
    the video moves: the gate can close everywhere while the painting is still bad, and above 0 it can open again.

    Args:
        frames: How many frames it sees, x_t the last of them.
        config: Its choices.

    Attributes:
        widths: The channels of the three depths.
    """

    def __init__(self, frames: int = 2, config: UNetConfig | None = None) -> None:
        super().__init__()
        config = config or UNetConfig()
        self.gate_floor = config.gate_floor
        self.widths = [config.width * usual for usual in WIDTHS]
        c, w, d = self.widths
        self.frames_in = conv(CHANNELS * frames, c, 1)
        self.level0 = block(c, c)
        self.down1, self.level1 = conv(c, w, stride=2), block(w, w)
        self.down2 = block(w, d, stride=2)
        self.middle = nn.ModuleList(block(d, d, gain=0.5) for _ in range(MIDDLE_BLOCKS))
        self.up1, self.merge1 = up(d, w), block(w, w)
        self.up0, self.merge0 = up(w, c), block(c, c)
        self.painting, self.gate = output(c, CHANNELS), output(c, PATCH**2)
        self.warps = config.warp
        if self.warps:
            self.flow, self.warp_gate = output(c, 2), output(c, PATCH**2)

    def next_frame(
        self,
        frames: Sequence[Float[Tensor, "m p hp wp"]],
        full: Float[Tensor, "b c h0 w0"],
        half: Float[Tensor, "b w h1 w1"] | float = 0.0,
        quarter: Float[Tensor, "b d h2 w2"] | float = 0.0,
        *,
        parent: Int[Tensor, " b"] | None = None,
        current: Float[Tensor, "b p hp wp"] | None = None,
    ) -> Float[Tensor, "b p hp wp"]:
        """The packed frame after some.

        Args:
            frames: The last ones, packed, x_t the last of them.
            full, half, quarter: What is added to the features of that size; broadcast if 1 x 1.
            parent: The row of ``frames`` that each row is of; None: its own.
            current: x_t of each row; None: as in ``frames``.
        """
        entered = rows_of(over_frames(self.frames_in, frames), parent) + full
        level0 = self.level0(F.leaky_relu_(entered, SLOPE))
        level1 = self.level1(F.leaky_relu_(self.down1(level0).add_(half), SLOPE))
        level2 = self.down2(level1) + quarter
        for inner in self.middle:
            level2 = level2 + inner(level2)
        level1 = level1 + self.merge1(level1 + self.up1(level2))
        level0 = self.merge0(level0 + self.up0(level1))
        if current is None:
            current = rows_of(frames[-1], parent)
        if self.warps:
            current = self._carried(current, level0)
        return torch.lerp(current, self.painting(level0), _share(self.gate, level0, OPENNESS, self.gate_floor))

    def _carried(
        self, current: Float[Tensor, "b p hp wp"], features: Float[Tensor, "b c hp wp"]
    ) -> Float[Tensor, "b p hp wp"]:
        """x_t, warped by the flow."""
        flow = LARGEST_FLOW * torch.tanh(self.flow(features).float() * (PATCH / LARGEST_FLOW))
        moved = patches(warped(unpack(current).float(), flow).to(current.dtype), PATCH)
        return torch.lerp(current, moved, _share(self.warp_gate, features))


class _Floor(torch.autograd.Function):
    """What is below a bound is raised to it, and its gradient goes on as long as it asks for more."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, openings: Tensor, bound: float) -> Tensor:
        ctx.save_for_backward(openings < bound)
        return openings.clamp(min=bound)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> tuple[Tensor, None]:
        (below,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return gradients[0].masked_fill(below & (gradients[0] > 0), 0.0), None


def _share(
    gate: nn.Conv2d, features: Float[Tensor, "b c hp wp"], openness: float = 0.0, floor: float = 0.0
) -> Float[Tensor, "b p hp wp"]:
    """How much of a new frame a gate lets in: one value per pixel, and the same again for each of the three colours.

    The gate's weights are repeated instead of its values. So all that follows is of one shape and one memory format;
    repeating the values makes the blending seven times as slow (docs/experiments/speed.md).
    """
    assert gate.bias is not None
    opening = F.conv2d(features, gate.weight.repeat(3, 1, 1, 1), (gate.bias + openness).repeat(3))
    if floor > 0:
        opening = _Floor.apply(opening, math.log(floor / (1 - floor)))  # type: ignore[no-untyped-call]
    return torch.sigmoid(opening)


class CodedUNet(UNet):
    """The U-Net with a vector at every place of its three depths: an action, or a latent one.

    Args:
        code: Length of the vector.
        frames, config: As for ``UNet``.
    """

    def __init__(self, code: int, frames: int = 2, config: UNetConfig | None = None) -> None:
        super().__init__(frames, config)
        self.code_in, self.code_1, self.code_2 = (linear(code, channels) for channels in self.widths)

    def forward(
        self,
        frames: Sequence[Float[Tensor, "m p hp wp"]],
        code: Float[Tensor, "b d"],
        *,
        parent: Int[Tensor, " b"] | None = None,
        current: Float[Tensor, "b p hp wp"] | None = None,
    ) -> Float[Tensor, "b p hp wp"]:
        full, half, quarter = (
            rearrange(layer(code), "b c -> b c 1 1") for layer in (self.code_in, self.code_1, self.code_2)
        )
        return self.next_frame(frames, full, half, quarter, parent=parent, current=current)
