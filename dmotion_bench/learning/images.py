"""Conversion between stored pixels (uint8, channels last) and models' images (in [-1, 1], channels first)."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def to_model(frames: UInt8[Tensor, "*b h w c"]) -> Float[Tensor, "*b c h w"]:
    """Pixels 0-255 to [-1, 1]. The memory stays channels last, the order that convolutions like best."""
    return frames.to(torch.float32).mul_(2 / 255).sub_(1).movedim(-1, -3)


def images_of_triplets(
    stored: UInt8[Tensor, "b 3 h w c"],
) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b c h w"], Float[Tensor, "b c h w"]]:
    """The previous, current and next images of stored triplets, as ``to_model`` makes them."""
    previous, current, following = stored.unbind(1)
    return to_model(previous), to_model(current), to_model(following)


def to_pixels(images: Float[Tensor, "*b c h w"]) -> UInt8[Tensor, "*b h w c"]:
    """[-1, 1] to whole pixel values 0-255, what lies outside clipped."""
    scaled = images.detach().float().add(1).mul_(255 / 2).round_().clamp_(0, 255)
    return scaled.to(torch.uint8).movedim(-3, -1).contiguous()
