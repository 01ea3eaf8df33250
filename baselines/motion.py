"""Ways to move a feature map: DMotion's spatial transformer, and cross convolution as its ablation.

A motion is a vector per map. For the transformers it holds parameters of the matrix theta of an inverse warp (Jaderberg
2015, eq. 1): the moved map at place p is the map at theta p, in [-1, 1] coordinates whose ends are the centres of
the outermost pixels (``align_corners``), and zero outside. Moving to the right is therefore a *negative* t_x.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

WHOLE_PIXEL = 1e-4
"""Added to whole-pixel shifts, where the hat function has a kink and its symmetric derivative is zero [px]."""

FOURIER_KERNEL = 11
"""Cross convolution with kernels from this side on is done in Fourier space."""


@runtime_checkable
class Motion(Protocol):
    """Moves each map by its own motion."""

    size: int
    """Numbers in one map's motion."""
    reversible: bool
    """Whether the motion back is the negative of the motion there; of six parameters nearly, for small ones."""

    def identity(self) -> Float[Tensor, " d"]:
        """The motion that leaves a map unchanged."""

    def __call__(
        self, maps: Float[Tensor, "b k h w"], motion: Float[Tensor, "b k d"], blur: float = 1.0
    ) -> Float[Tensor, "b k h w"]:
        """The moved maps."""


class _SeparableShift(torch.autograd.Function):
    """Translation as two small matrix products per map, with its gradient written out.

    Bilinear interpolation with a shift is separable: moved = A_y m A_x^T, where row i of A holds the hat function
    around the place that output i is read from. Half the time of autograd through the same formula, and several times
    faster than ``grid_sample`` in bfloat16, which is not vectorised on the CPU.
    """

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, maps: Tensor, shift: Tensor, blur: float) -> Tensor:
        size = maps.shape[-1]
        pixels = shift.float() * ((size - 1) / 2)
        pixels = pixels + (pixels == pixels.round()) * WHOLE_PIXEL
        offsets = torch.arange(size - 1, -size, -1, dtype=torch.float32, device=maps.device)
        distance = pixels[..., None] + offsets  # b k (x y) 2n-1: from the place read to each pixel
        hat = (1 - distance.abs() / blur).clamp_(min=0)
        across, down = _toeplitz(hat / blur, maps.dtype)
        rows = maps @ across.mT
        slope = distance.sign() * (hat > 0) * (-(size - 1) / 2 / blur**2)
        ctx.save_for_backward(maps, rows, across, down, *_toeplitz(slope, maps.dtype))
        return down @ rows

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        maps, rows, across, down, slope_across, slope_down = ctx.saved_tensors  # type: ignore[attr-defined]
        gradient = gradients[0].contiguous()
        of_rows = down.mT @ gradient
        of_x = (of_rows * (maps @ slope_across.mT)).sum((2, 3), dtype=torch.float32)
        of_y = (gradient * (slope_down @ rows)).sum((2, 3), dtype=torch.float32)
        return of_rows @ across, torch.stack([of_x, of_y], dim=2), None


def _toeplitz(diagonals: Float[Tensor, "b k a n"], dtype: torch.dtype) -> tuple[Float[Tensor, "b k s s"], ...]:
    """Of each axis the matrix W with W[i, j] = diagonals[s - 1 - i + j]: only 2 s - 1 values, read through a window.

    Each lies in memory by itself, so that a batched product need not copy it first.
    """
    size = (diagonals.shape[-1] + 1) // 2
    return tuple(axis.unfold(-1, size, 1).flip(-2) for axis in diagonals.to(dtype).unbind(2))


class Translation:
    """Translation only: two free parameters of theta. The default in all environments, as in the original."""

    size = 2
    reversible = True

    def identity(self) -> Float[Tensor, "2"]:
        """No shift."""
        return torch.zeros(2)

    def __call__(
        self, maps: Float[Tensor, "b k h w"], motion: Float[Tensor, "b k 2"], blur: float = 1.0
    ) -> Float[Tensor, "b k h w"]:
        """Bilinear sampling; ``blur`` > 1 widens the kernel, so that the gradient reaches further."""
        moved: Tensor = _SeparableShift.apply(maps.contiguous(), motion, blur)  # type: ignore[no-untyped-call]
        return moved


class AffineMotion:
    """All six parameters of theta, row by row (Jaderberg 2015); ``blur`` is not used."""

    size = 6
    reversible = True

    def identity(self) -> Float[Tensor, "6"]:
        """The unit matrix."""
        return torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])

    def __call__(
        self, maps: Float[Tensor, "b k h w"], motion: Float[Tensor, "b k 6"], blur: float = 1.0
    ) -> Float[Tensor, "b k h w"]:
        """Bilinear sampling, zeros outside."""
        flat = rearrange(maps, "b k h w -> (b k) 1 h w")
        theta = rearrange(motion, "b k (i j) -> (b k) i j", i=2).to(maps.dtype)
        grid = F.affine_grid(theta, list(flat.shape), align_corners=True)
        moved = F.grid_sample(flat, grid, padding_mode="zeros", align_corners=True)
        return rearrange(moved, "(b k) 1 h w -> b k h w", b=len(maps))


class CrossConvolution:
    """Each map convolved with a kernel of its own (Xue 2016, Visual Dynamics); ``blur`` is not used.

    Args:
        kernel: Side of the kernel; it moves a map by at most (kernel - 1) / 2 pixels.
    """

    reversible = False

    def __init__(self, kernel: int) -> None:
        self.kernel, self.size = kernel, kernel * kernel

    def identity(self) -> Float[Tensor, " d"]:
        """A kernel with one in the middle and zeros elsewhere."""
        return torch.tensor([float(place == self.size // 2) for place in range(self.size)])

    def __call__(
        self, maps: Float[Tensor, "b k h w"], motion: Float[Tensor, "b k d"], blur: float = 1.0
    ) -> Float[Tensor, "b k h w"]:
        """Cross-correlation, zeros outside."""
        kernels = rearrange(motion, "b k (i j) -> b k i j", i=self.kernel)
        if self.kernel >= FOURIER_KERNEL:
            return _fourier_correlation(maps, kernels)
        b, k = maps.shape[:2]
        flat = rearrange(maps, "b k h w -> 1 (b k) h w")
        weights = rearrange(kernels, "b k i j -> (b k) 1 i j").to(maps.dtype)
        moved = F.conv2d(flat, weights, padding=self.kernel // 2, groups=b * k)
        return rearrange(moved, "1 (b k) h w -> b k h w", b=b)


def _fourier_correlation(maps: Float[Tensor, "b k h w"], kernels: Float[Tensor, "b k i i"]) -> Float[Tensor, "b k h w"]:
    """Cross-correlation as a product of spectra: nine times faster than the sum where the kernel is of 27."""
    height, width, reach = maps.shape[-2], maps.shape[-1], kernels.shape[-1] // 2
    size = (height + 2 * reach, width + 2 * reach)  # so that nothing wraps around
    spectrum = torch.fft.rfft2(maps.float(), s=size) * torch.fft.rfft2(kernels.float(), s=size).conj()
    moved = torch.fft.irfft2(spectrum, s=size).roll((reach, reach), (-2, -1))
    inside: Tensor = moved[..., :height, :width]
    return inside.to(maps.dtype)


def theta_of_shift(shift: Float[Tensor, "*b 2"], size: int) -> Float[Tensor, "*b 2"]:
    """The translation (t_x, t_y) that moves a map of ``size`` pixels by ``shift`` = (right, down) [px of the map]."""
    return -shift * 2 / (size - 1)


def pixel_shift(translation: Float[Tensor, "*b 2"], size: int) -> Float[Tensor, "*b 2"]:
    """How far a translation (t_x, t_y) moves a map of ``size`` pixels: (right, down) [px of the map]."""
    return -translation * (size - 1) / 2
