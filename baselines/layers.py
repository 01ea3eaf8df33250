"""The compact backbone that the models share where their papers leave it open.

Everything runs on 4 x 4 patches of the frame as 48 channels, at a quarter of its side and below: wide convolutions on
small maps keep the CPU's bfloat16 units busy, narrow ones on large maps wait for memory. There is no normalisation:
scaled initial weights and residual connections do without. What this bought is measured in decision 018.

Frames are *packed*: ``Float[b 48 h/4 w/4]``, channels-last in memory.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from baselines.patches import CHANNELS
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import Losses, ModelInputs

SLOPE = 0.2
WIDTHS = (32, 64, 128)
OUTPUT_GAIN = 0.35


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
    """Mark parameters for ``named_optimizer`` that Adam trains instead of Muon, with a factor on the learning rate."""
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
