"""The one translation that explains best what changes between two frames: block matching, without a label.

For a shift s of frame a towards frame b let e(s) be the sum, over all pixels p, of

    w(p) |b(p) - a(p - s)|^2  +  w(p) |a(p) - b(p + s)|^2,      w(p) = |b(p) - a(p)|^2.

So only what changed has a say. A thing that moves by s before a plain background leaves nothing in either term: its new
place is found at its old one, and what it uncovers where it came from. Where p - s or p + s is outside of the picture,
the term counts as much as without a shift. The two terms together make the shift from b to a the opposite of that from
a to b, and tell a thing that comes from a corner from one that comes from nowhere.

Of a thing of one colour that moves by less than its size, every shift from its step to its size explains all of the
change: the pixels in between do not change and have no say. Which of these shifts is found, rounding decides.

All shifts are tried at once: each sum is a correlation, a product of spectra (Lewis 1995, "Fast normalized
cross-correlation", has the method). The least one is refined by a parabola through its neighbours.
"""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

SIDE: Final = 64
"""Frames are reduced to about so many pixels a side."""
REACH: Final = 0.3
"""The largest shift along each axis, of the frame's side."""

FAST: Final = 12  # spectra of sizes that it divides are quick


class Shift(NamedTuple):
    """What explains the change between frames.

    Attributes:
        pixels: (right, down), of the whole frame [px].
        confidence: From 0 where it explains half of the change or less, as some shift does between any two pictures,
            to 1 where it explains all of it; 0 where nothing changes.
    """

    pixels: Float[Tensor, "b 2"]
    confidence: Float[Tensor, " b"]


@torch.no_grad()
def dominant_shift(before: Float[Tensor, "b c h w"], after: Float[Tensor, "b c h w"]) -> Shift:
    """The shift that explains best what changes from one square frame to another; frames in [-1, 1]."""
    with torch.autocast(before.device.type, enabled=False):
        scale = max(1, before.shape[-1] // SIDE)
        one, other = (_reduced(frame, scale) for frame in (before, after))
        reach = max(1, round(REACH * one.shape[-1]))
        change = (other - one).square().sum(1, keepdim=True)
        left = _left_unexplained(one, other, change, reach)
        side = 2 * reach + 1
        best = left.flatten(1).argmin(1)
        row, column = best // side, best % side
        rows = torch.arange(len(left), device=left.device)
        least = left[rows, row, column]
        still = left[:, reach, reach]
        middle_row, middle_column = (place.clamp(1, side - 2) for place in (row, column))
        down = _parabola(*(left[rows, middle_row + step, column] for step in (-1, 0, 1)))
        right = _parabola(*(left[rows, row, middle_column + step] for step in (-1, 0, 1)))
        down = torch.where(middle_row == row, down, 0.0)  # at the window's edge one side of the parabola is unknown
        right = torch.where(middle_column == column, right, 0.0)
        return Shift(
            pixels=scale * torch.stack([column - reach + right, row - reach + down], dim=1),
            confidence=torch.where(still > 0, 1 - 2 * least / still.clamp(min=1e-12), 0.0).clamp(0, 1),
        )


def _reduced(frame: Float[Tensor, "b c h w"], scale: int) -> Float[Tensor, "b c y x"]:
    """The mean of each block of ``scale`` x ``scale`` pixels, contiguous and in float32, as ``F.avg_pool2d`` has it.

    Added up place by place this takes a third of the time, in whichever order the frame lies in memory.
    """
    if scale == 1:
        return frame.float().contiguous()
    height, width = (side // scale * scale for side in frame.shape[-2:])
    total = None
    for down, right in itertools.product(range(scale), repeat=2):
        part = frame[..., down:height:scale, right:width:scale].float()
        total = part.clone() if total is None else total.add_(part)
    assert total is not None
    return total.div_(scale**2).contiguous()


def _left_unexplained(
    one: Float[Tensor, "b c h w"], other: Float[Tensor, "b c h w"], change: Float[Tensor, "b 1 h w"], reach: int
) -> Float[Tensor, "b y x"]:
    """e(s) of all shifts up to ``reach``; that of (right, down) is at [reach + down, reach + right]."""
    size = tuple(-(-(side + reach) // FAST) * FAST for side in one.shape[-2:])  # so that nothing comes round

    def spectrum(values: Tensor) -> Tensor:
        found: Tensor = torch.fft.rfft2(values, s=size)
        return found

    inside = spectrum(torch.ones_like(change[:1])).conj()
    weight, as_it_is = spectrum(change), spectrum(change * change)

    def correlated(here: Tensor, there: Tensor) -> Tensor:
        """The sum over p of w(p) |here(p) - there(p - s)|^2, less what it is without a shift."""
        squares = spectrum(there.square().sum(1, keepdim=True))
        own = spectrum(change * here.square().sum(1, keepdim=True))
        both = (spectrum(change * here) * spectrum(there).conj()).sum(1, keepdim=True)
        return (own - as_it_is) * inside - 2 * both + weight * squares.conj()

    back, forth = correlated(other, one), correlated(one, other).conj()  # the second looks the other way
    sums: Tensor = torch.fft.irfft2(back + forth, s=size)[:, 0] + 2 * (change * change).sum((1, 2, 3))[:, None, None]
    return sums.roll((reach, reach), (1, 2))[:, : 2 * reach + 1, : 2 * reach + 1]


def _parabola(
    before: Float[Tensor, " b"], here: Float[Tensor, " b"], after: Float[Tensor, " b"]
) -> Float[Tensor, " b"]:
    """How far the lowest point of the parabola through three neighbours is from the middle one, at most half."""
    bend: Tensor = (before - 2 * here + after).clamp(min=1e-12)
    return (0.5 * (before - after) / bend).clamp(-0.5, 0.5)
