"""How alike two pictures are: MSE, PSNR and SSIM, each per frame, on whole pixel values 0-255.

MSE is the mean over all pixels and channels of a frame (the paper's, section V-C). PSNR is 10 log10(255^2 / MSE)
of each frame, at most ``PSNR_CAP``; a report's PSNR is the mean of the frames' PSNRs, not the PSNR of their mean
MSE. SSIM is Wang et al. 2004 with its authors' settings: a Gaussian window of 11 x 11 with sigma 1.5, population
variances, K1 = .01, K2 = .03, L = 255, windows that lie wholly inside the frame; the mean over windows and over
the three channels taken one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from dmotion_bench.errors import InvalidSetting

PSNR_CAP = 100.0
"""Of identical frames [dB]. Different frames stay below it up to 226 x 226 pixels (at 128 x 128: 95.05)."""

WINDOW, SIGMA = 11, 1.5
C1, C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2

FRAMES_AT_ONCE = 2  # on a CPU, so that what is computed with stays in the cache: twice as fast as 16 [measured]


def mean_squared_error(predicted: UInt8[Tensor, "b h w c"], truth: UInt8[Tensor, "b h w c"]) -> Float[Tensor, " b"]:
    """Of each frame, over all pixels and channels; float64, exact."""
    return _few_at_once(_mse, predicted, truth)


def peak_signal_to_noise(mse: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """Of each frame, from its MSE [dB]."""
    return (10 * torch.log10(255**2 / mse)).clamp(max=PSNR_CAP)


def structural_similarity(predicted: UInt8[Tensor, "b h w c"], truth: UInt8[Tensor, "b h w c"]) -> Float[Tensor, " b"]:
    """Of each frame; 1 for identical ones, exactly.

    Raises:
        InvalidSetting: The frames are smaller than the window.
    """
    height, width = predicted.shape[1:3]
    if min(height, width) < WINDOW:
        raise InvalidSetting(f"frames are {height} x {width}; SSIM needs at least {WINDOW} x {WINDOW} pixels.")
    return _few_at_once(_ssim, predicted, truth)


def _few_at_once(
    measure: Callable[[Tensor, Tensor], Tensor], predicted: UInt8[Tensor, "b h w c"], truth: UInt8[Tensor, "b h w c"]
) -> Float[Tensor, " b"]:
    size = FRAMES_AT_ONCE if predicted.device.type == "cpu" else max(1, len(predicted))
    figures = torch.empty(len(predicted), dtype=torch.float64, device=predicted.device)
    for start in range(0, len(predicted), size):
        part = slice(start, start + size)
        figures[part] = measure(predicted[part], truth[part])
    return figures


def _mse(predicted: UInt8[Tensor, "b h w c"], truth: UInt8[Tensor, "b h w c"]) -> Float[Tensor, " b"]:
    squared = (predicted.float() - truth.float()).square_().flatten(1)
    return squared.sum(1, dtype=torch.float64) / squared.shape[1]


def _ssim(predicted: UInt8[Tensor, "b h w c"], truth: UInt8[Tensor, "b h w c"]) -> Float[Tensor, " b"]:
    """Four window means instead of five: those of s = x + y and d = x - y and of their squares hold all the rest.

    E[x^2] + E[y^2] = (E[s^2] + E[d^2]) / 2 and E[xy] = (E[s^2] - E[d^2]) / 4. Values are centred on 127.5 before
    they are squared, which keeps float32 exact enough.
    """
    x, y = (frames.movedim(-1, 1).float().sub_(127.5) for frames in (predicted, truth))
    total, difference = x + y, x - y
    stacked = torch.stack([total, difference, total * total, difference * difference])
    mean_s, mean_d, power_s, power_d = _windows(stacked).unbind()
    spread_s, spread_d = power_s - mean_s * mean_s, power_d - mean_d * mean_d
    square_s, square_d = (mean_s + 255).square_(), mean_d.square()
    top = ((square_s - square_d) / 2 + C1) * ((spread_s - spread_d) / 2 + C2)
    bottom = ((square_s + square_d) / 2 + C1) * ((spread_s + spread_d) / 2 + C2)
    return (top / bottom).mean((1, 2, 3))


def _windows(maps: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b y x"]:
    """The Gaussian mean of every window, one axis after the other; the kernel is symmetric, so two rows share a tap."""
    taps = _taps()
    middle = WINDOW // 2
    for axis in (-2, -1):
        size = maps.shape[axis] - WINDOW + 1
        mean = maps.narrow(axis, middle, size) * taps[middle]
        for place in range(middle):
            pair = maps.narrow(axis, place, size) + maps.narrow(axis, WINDOW - 1 - place, size)
            mean.add_(pair, alpha=taps[place])
        maps = mean
    return maps


@cache
def _taps() -> list[float]:
    offset = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-(offset**2) / (2 * SIGMA**2))
    taps: list[float] = (weights / weights.sum()).tolist()
    return taps
