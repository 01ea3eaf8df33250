"""The shared layers against torch's own."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from baselines.layers import RoundConv2d, pack, unpack


def test_a_round_convolution_is_circular_padding_in_value_and_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    for stride, height, width in ((1, 6, 8), (2, 8, 6)):
        layer = RoundConv2d(3, 4, stride)
        picture = torch.randn(2, 3, height, width, generator=generator).to(memory_format=torch.channels_last)
        picture.requires_grad_()
        fast = layer(picture)
        slow = F.conv2d(F.pad(picture, (1, 1, 1, 1), mode="circular"), layer.weight, layer.bias, stride)
        torch.testing.assert_close(fast, slow, atol=1e-5, rtol=1e-5)
        weight = torch.randn(fast.shape, generator=generator)
        (of_fast,) = torch.autograd.grad((fast * weight).sum(), picture)
        (of_slow,) = torch.autograd.grad((slow * weight).sum(), picture)
        torch.testing.assert_close(of_fast, of_slow, atol=1e-5, rtol=1e-5)


def test_packing_moves_pixels_and_loses_none() -> None:
    image = torch.rand(2, 3, 16, 32, generator=torch.Generator().manual_seed(0))
    packed = pack(image)
    assert packed.shape == (2, 48, 4, 8)
    assert packed.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(unpack(packed), image)
    patch = packed[0, :, 2, 5].reshape(3, 4, 4)
    assert torch.equal(patch, image[0, :, 8:12, 20:24])
