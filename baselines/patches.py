"""Frames as patches: p x p pixels become channels and back, one copy each way.

A row of a patch is moved as one wide number, such as four bfloat16 pixels as one of 64 bits: copying takes about as
long for a wide number as for a narrow one.
"""

from __future__ import annotations

from typing import Final

import torch
from einops import rearrange
from jaxtyping import Float, Int, Shaped
from torch import Tensor

PATCH: Final = 4
CHANNELS: Final = 3 * PATCH**2  # of a packed frame
WIDE: Final = {4: torch.int32, 8: torch.int64, 16: torch.complex128}
"""By bytes: types as which a patch's row is copied."""


def pack(image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b p hp wp"]:
    """4 x 4 patches as channels, channels-last in memory; in autocast's type within autocast."""
    return patches(in_autocast(image), PATCH)


def in_autocast(values: Float[Tensor, "*d"]) -> Float[Tensor, "*d"]:
    """The values in autocast's type, within autocast."""
    if torch.is_autocast_enabled(values.device.type):
        return values.to(torch.get_autocast_dtype(values.device.type))
    return values


def rows_of(maps: Float[Tensor, "m c h w"], rows: Int[Tensor, " n"] | None) -> Float[Tensor, "n c h w"]:
    """Some rows of a batch, in the batch's memory format; all if None."""
    if rows is None:
        return maps
    if maps.is_contiguous():
        return maps.index_select(0, rows)
    return maps.permute(0, 2, 3, 1).index_select(0, rows).permute(0, 3, 1, 2)


def unpack(packed: Float[Tensor, "b p hp wp"]) -> Float[Tensor, "b c h w"]:
    """Channels as 4 x 4 patches."""
    return from_patches(packed, PATCH)


def patches(image: Float[Tensor, "b c h w"], side: int) -> Float[Tensor, "b p hp wp"]:
    """Turn patches into channels, c p q with p downwards; the result is channels-last in memory."""
    together: Tensor = _ToPatches.apply(image, side)  # type: ignore[no-untyped-call]
    return together


def from_patches(packed: Shaped[Tensor, "b p hp wp"], side: int) -> Shaped[Tensor, "b c h w"]:
    """Turn channels into patches; the result is contiguous."""
    image: Tensor = _FromPatches.apply(packed, side)  # type: ignore[no-untyped-call]
    return image


class _ToPatches(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, image: Tensor, side: int) -> Tensor:
        ctx.side = side  # type: ignore[attr-defined]
        rows = _rows(image.contiguous(), side)
        together = rearrange(rows, "b c (h p) w -> b h w (c p)", p=side).contiguous()
        return together.view(image.dtype).permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> tuple[Tensor, None]:
        return from_patches(gradients[0], ctx.side), None  # type: ignore[attr-defined]


class _FromPatches(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, packed: Tensor, side: int) -> Tensor:
        ctx.side = side  # type: ignore[attr-defined]
        rows = _rows(packed.permute(0, 2, 3, 1).contiguous(), side)
        apart = rearrange(rows, "b h w (c p) -> b c (h p) w", p=side).contiguous()
        return apart.view(packed.dtype)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> tuple[Tensor, None]:
        return patches(gradients[0], ctx.side), None  # type: ignore[attr-defined]


def _rows(values: Tensor, side: int) -> Tensor:
    """The same memory, in which so many values in a row are one number: ``[... w]`` to ``[... w/side]``."""
    return values.view(WIDE[side * values.element_size()])
