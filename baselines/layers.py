"""The compact backbone that the models share where their papers leave it open.

Everything runs on 4 x 4 patches of the frame as 48 channels, at a quarter of its side and below: wide convolutions on
small maps keep the CPU's bfloat16 units busy, narrow ones on large maps wait for memory. There is no normalisation:
scaled initial weights and residual connections do without. What this bought is measured in decision 018.

Frames are *packed*: ``Float[b 48 h/4 w/4]``, channels-last in memory.
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

from baselines.patches import CHANNELS, PATCH, patches, rows_of, unpack
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import Losses, ModelInputs

SLOPE = 0.2
WIDTHS = (32, 64, 128)
MIDDLE_BLOCKS = 3
OUTPUT_GAIN = 0.35
OPENNESS = -1.0  # of the gate before training: it lets in a quarter of what is new
LARGEST_FLOW = 20.0  # [px]: about two steps of an agent


def check_size(model: str, inputs: ModelInputs) -> None:
    """Raise an error unless the frame's sides can be halved down to the smallest map.

    Raises:
        InvalidSetting: They do not.
    """
    if inputs.height % 16 or inputs.width % 16:
        raise InvalidSetting(
            f"frames are {inputs.height} x {inputs.width}; {model} takes ones whose sides are multiples of 16."
        )


class _SquaredError(torch.autograd.Function):
    """``squared_error``, which keeps one difference for its gradient and makes no other copy of the frames."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, predicted: Tensor, true: Tensor) -> Tensor:
        difference = predicted - true
        ctx.save_for_backward(difference.to(predicted.dtype))
        wide = torch.promote_types(difference.dtype, torch.float32)
        norm: Tensor = torch.linalg.vector_norm(difference, dim=tuple(range(1, difference.ndim)), dtype=wide)
        return norm.square() / (difference.numel() // len(difference))

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        (difference,) = ctx.saved_tensors  # type: ignore[attr-defined]
        of_each = gradients[0] * (2 * len(difference) / difference.numel())
        of_predicted = difference * of_each.to(difference.dtype).view(-1, *[1] * (difference.ndim - 1))
        return of_predicted, -of_predicted if ctx.needs_input_grad[1] else None  # type: ignore[attr-defined]


def squared_error(predicted: Float[Tensor, "b *d"], true: Float[Tensor, "b *d"]) -> Float[Tensor, " b"]:
    """The squared error of each row, averaged over all other axes, in float32.

    The difference of two frames in bfloat16 is rounded to bfloat16; where they are nearly alike, it is exact.
    """
    each: Tensor = _SquaredError.apply(predicted, true)  # type: ignore[no-untyped-call]
    return each


def reconstruction_losses(drawn: Float[Tensor, "b *d"], true: Float[Tensor, "b *d"]) -> Losses:
    """The loss that trains a decoder: the squared error of the frames that it draws."""
    each = squared_error(drawn, true)
    mean = each.mean()
    return Losses(total=mean, terms={"reconstruction": mean.detach()}, per_triplet=each.detach())


class _Wrap(torch.autograd.Function):
    """One more row and column on each side, from the opposite one; one copy each way, channels-last throughout.

    ``torch.cat`` and circular ``F.pad`` take as long as the convolution that follows them (decision 018).
    """

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, picture: Tensor) -> Tensor:
        inner = picture.permute(0, 2, 3, 1)
        b, h, w, c = inner.shape
        wide = inner.new_empty(b, h + 2, w + 2, c)
        wide[:, 1:-1, 1:-1] = inner
        wide[:, 0, 1:-1], wide[:, -1, 1:-1] = inner[:, -1], inner[:, 0]
        wide[:, :, 0], wide[:, :, -1] = wide[:, :, -2], wide[:, :, 1]
        return wide.permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> Tensor:
        wide = gradients[0].permute(0, 2, 3, 1)
        inner = wide[:, 1:-1, 1:-1].clone(memory_format=torch.contiguous_format)
        inner[:, :, 0] += wide[:, 1:-1, -1]
        inner[:, :, -1] += wide[:, 1:-1, 0]
        inner[:, 0] += wide[:, -1, 1:-1]
        inner[:, -1] += wide[:, 0, 1:-1]
        for row, column in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
            inner[:, row, column] += wide[:, -1 - row, -1 - column]
        return inner.permute(0, 3, 1, 2)


class RoundConv2d(nn.Conv2d):
    """A 3 x 3 convolution with circular padding: the last column is next to the first.

    Padding with zeros tells a network how far from the edge it is. Here it cannot know where in the picture it looks:
    rolling the picture rolls the result (by whole strides).
    """

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(inputs, outputs, 3, stride)

    def forward(self, picture: Float[Tensor, "b c h w"]) -> Float[Tensor, "b o y x"]:
        convolved: Tensor = super().forward(_Wrap.apply(picture))  # type: ignore[no-untyped-call]
        return convolved


def conv(
    inputs: int, outputs: int, kernel: int = 3, stride: int = 1, gain: float = 1.0, *, edges: bool = True
) -> nn.Conv2d:
    """A convolution with He's initial weights times ``gain``: without normalisation they alone keep the scale."""
    if edges or kernel == 1:
        layer = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2)
    else:
        layer = RoundConv2d(inputs, outputs, stride)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE)
    with torch.no_grad():
        layer.weight.mul_(gain)
        layer.bias.zero_()  # type: ignore[union-attr]
    return layer


def over_frames(layer: nn.Conv2d, frames: Sequence[Float[Tensor, "b _ y x"]]) -> Float[Tensor, "b o y x"]:
    """A 1 x 1 convolution of frames one behind the other in the channels: the sum of what it makes of each.

    So nothing is copied to put them there, and the gradient of the weights takes less time than of wide inputs.
    """
    shares = torch.split(layer.weight, [frame.shape[1] for frame in frames], dim=1)
    total = F.conv2d(frames[0], shares[0], layer.bias)
    for frame, share in zip(frames[1:], shares[1:], strict=True):
        total += F.conv2d(frame, share)
    return total


def output(inputs: int, outputs: int) -> nn.Conv2d:
    """A 1 x 1 convolution that ends a network: small at first, and left to Adam where Muon trains the rest."""
    layer = conv(inputs, outputs, 1, gain=OUTPUT_GAIN)
    left_to_adam(layer.weight)
    return layer


def left_to_adam(*weights: Tensor, rate: float = 1.0) -> None:
    """Mark parameters for ``make_optimizer`` that Adam trains instead of Muon, with a factor on the learning rate."""
    for weight in weights:
        vars(weight).update(is_output=True, rate_factor=rate)


def block(
    inputs: int, outputs: int, kernel: int = 3, stride: int = 1, gain: float = 1.0, *, edges: bool = True
) -> nn.Sequential:
    """A convolution and its activation, together keeping the variance (times gain squared)."""
    layer = conv(inputs, outputs, kernel, stride, gain, edges=edges)
    return nn.Sequential(layer, nn.LeakyReLU(SLOPE, inplace=True))


class Up2d(nn.ConvTranspose2d):
    """A transposed convolution of kernel 2 and stride 2, computed as what it is: a matrix product for each pixel.

    Its gradient takes less than half as long as that of the general convolution (docs/experiments/speed.md).
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 2, 2)

    def forward(
        self, picture: Float[Tensor, "b c h w"], output_size: list[int] | None = None
    ) -> Float[Tensor, "b o y x"]:
        assert self.bias is not None
        assert output_size is None, "the size is twice the input's"
        matrix = rearrange(self.weight, "c o p q -> (p q o) c")
        made = F.linear(picture.permute(0, 2, 3, 1), matrix, self.bias.repeat(4))
        return rearrange(made, "b h w (p q o) -> b (h p) (w q) o", p=2, q=2).permute(0, 3, 1, 2)


def up(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    """Twice the size; each input pixel makes a 2 x 2 patch."""
    layer = Up2d(inputs, outputs)
    nn.init.normal_(layer.weight, std=0.7 * inputs**-0.5)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


def linear(inputs: int, outputs: int, gain: float = 1.0) -> nn.Linear:
    """A linear layer whose output has the variance of its input times gain squared."""
    layer = nn.Linear(inputs, outputs)
    nn.init.normal_(layer.weight, std=gain * inputs**-0.5)
    nn.init.zeros_(layer.bias)
    return layer


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
        level0 = self.level0(F.leaky_relu(rows_of(over_frames(self.frames_in, frames), parent) + full, SLOPE))
        level1 = self.level1(F.leaky_relu(self.down1(level0) + half, SLOPE))
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


class FrameEncoder(nn.Module):
    """Encodes packed frames into a vector.

    Args:
        inputs: The size of the frames.
        features: Length of the vector.
        frames: How many frames, one behind the other in the channels.
    """

    def __init__(self, inputs: ModelInputs, features: int, frames: int = 1) -> None:
        super().__init__()
        c, w, d = WIDTHS
        self.convolutions = nn.Sequential(
            block(CHANNELS * frames, c, 1),
            block(c, w, stride=2),
            block(w, w),
            block(w, d, stride=2),
            block(d, c, 1),
        )
        self.out = linear(c * (inputs.height // 16) * (inputs.width // 16), features)

    def forward(self, packed: Float[Tensor, "b p hp wp"]) -> Float[Tensor, "b d"]:
        vector: Tensor = self.out(rearrange(self.convolutions(packed), "b c h w -> b (h w c)"))
        return vector


class FrameDecoder(nn.Module):
    """Decodes a vector into a packed frame.

    Args:
        inputs: The size of the frame.
        features: Length of the vector.
        hidden: Width of the layer between the vector and the smallest map; None: one linear map leads there, which
            carries over to other layouts where the vector is a linear map of features, too (decision 024).
    """

    def __init__(self, inputs: ModelInputs, features: int, hidden: int | None) -> None:
        super().__init__()
        c, w, d = WIDTHS
        self.height, self.width = inputs.height // 16, inputs.width // 16
        smallest = c * self.height * self.width
        gain = nn.init.calculate_gain("leaky_relu", SLOPE)
        self.vector = (
            linear(features, smallest)
            if hidden is None
            else nn.Sequential(
                linear(features, hidden, gain),
                nn.LeakyReLU(SLOPE),
                linear(hidden, smallest, gain),
                nn.LeakyReLU(SLOPE),
            )
        )
        self.layers = nn.Sequential(
            block(c, d),
            up(d, w),
            block(w, w),
            up(w, c),
            block(c, c),
            output(c, CHANNELS),
        )

    def forward(self, vector: Float[Tensor, "b d"]) -> Float[Tensor, "b p hp wp"]:
        smallest = rearrange(self.vector(vector), "b (h w c) -> b c h w", h=self.height, w=self.width)
        packed: Tensor = self.layers(smallest)
        return packed


class MotionTrunk(nn.Module):
    """Encodes packed frames into a vector that tells what moved and how, but not where.

    Features are summed over the picture, and the picture has no edges.

    Args:
        frames: How many frames, one behind the other in the channels.
    """

    length = WIDTHS[2]

    def __init__(self, frames: int) -> None:
        super().__init__()
        c, w, d = WIDTHS
        self.convolutions = nn.Sequential(
            block(CHANNELS * frames, c, 1),
            block(c, w, stride=2, edges=False),
            block(w, w, edges=False),
            block(w, w, stride=2, edges=False),
            block(w, w, edges=False),
        )
        self.hidden = block(w, d, 1)

    def summarise(self, frames: Sequence[Float[Tensor, "b p hp wp"]]) -> Float[Tensor, "b d"]:
        """The vector that tells what moved between packed frames, and how."""
        entry, others = self.convolutions[0], self.convolutions[1:]
        assert isinstance(entry, nn.Sequential)
        assert isinstance(entry[0], nn.Conv2d)
        features: Tensor = others(entry[1](over_frames(entry[0], frames)))
        summed = features.sum((2, 3), keepdim=True) * 0.1
        summary: Tensor = self.hidden(summed).flatten(1)
        return summary
