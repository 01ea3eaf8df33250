"""The shared layers against torch's own."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from baselines.layers import RoundConv2d, conv, over_frames, squared_error, up
from baselines.patches import CHANNELS, from_patches, pack, patches, unpack


def test_frames_enter_a_convolution_one_by_one_as_if_side_by_side() -> None:
    generator = torch.Generator().manual_seed(0)
    layer = conv(3 * CHANNELS, 8, 1).double()
    assert layer.bias is not None
    torch.nn.init.normal_(layer.bias, generator=generator)
    frames = [torch.randn(2, CHANNELS, 4, 6, generator=generator, dtype=torch.float64) for _ in range(3)]
    found, expected = over_frames(layer, frames), layer(torch.cat(frames, dim=1))
    torch.testing.assert_close(found, expected)
    weight = torch.randn(found.shape, generator=generator, dtype=torch.float64)
    parameters = [*layer.parameters()]
    of_found, of_expected = (torch.autograd.grad((one * weight).sum(), parameters) for one in (found, expected))
    torch.testing.assert_close(of_found, of_expected)


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


@pytest.mark.parametrize(("dtype", "side"), [(torch.bfloat16, 2), (torch.bfloat16, 4), (torch.float32, 4)])
def test_patches_are_what_pixel_unshuffle_gives_whatever_lies_in_them(dtype: torch.dtype, side: int) -> None:
    bits = torch.randint(-(2**15), 2**15, (2, 3, 8, 16 * dtype.itemsize // 2), dtype=torch.int16)
    image = bits.view(dtype)  # any bits, those of no number among them
    for given in (image, image.contiguous(memory_format=torch.channels_last)):
        packed = patches(given, side)
        assert packed.is_contiguous(memory_format=torch.channels_last)
        assert torch.equal(packed.contiguous().view(torch.int16), F.pixel_unshuffle(image, side).view(torch.int16))
        assert torch.equal(from_patches(packed, side).view(torch.int16), bits)


def test_the_gradient_of_patches_is_their_inverse() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(2, 3, 8, 16, generator=generator).requires_grad_()
    packed = torch.randn(2, 12, 4, 8, generator=generator).requires_grad_()
    for fast, slow, given in ((patches, F.pixel_unshuffle, image), (from_patches, F.pixel_shuffle, packed)):
        result = fast(given, 2)
        weight = torch.randn(result.shape, generator=generator)
        (of_fast,) = torch.autograd.grad((result * weight).sum(), given)
        (of_slow,) = torch.autograd.grad((slow(given, 2) * weight).sum(), given)
        assert torch.equal(of_fast, of_slow)


def test_upsampling_is_the_transposed_convolution_in_value_and_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    layer = up(6, 4).double()
    assert layer.bias is not None
    torch.nn.init.normal_(layer.bias, generator=generator)
    picture = torch.randn(2, 6, 3, 5, generator=generator, dtype=torch.float64).requires_grad_()
    fast, slow = layer(picture), F.conv_transpose2d(picture, layer.weight, layer.bias, 2)
    assert fast.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(fast, slow)
    weight = torch.randn(fast.shape, generator=generator, dtype=torch.float64)
    given = (picture, layer.weight, layer.bias)
    torch.testing.assert_close(
        torch.autograd.grad((fast * weight).sum(), given), torch.autograd.grad((slow * weight).sum(), given)
    )


@pytest.mark.parametrize("shape", [(3, 4, 6, 5), (2, 7)])
def test_squared_errors_have_the_gradient_of_the_plain_formula(shape: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    predicted, true = (torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2))
    weight = torch.rand(len(predicted), generator=generator, dtype=torch.float64)
    plain = (predicted - true).square().flatten(1).mean(1)
    torch.testing.assert_close(squared_error(predicted, true), plain)
    of_plain = torch.autograd.grad((plain * weight).sum(), (predicted, true))
    of_fast = torch.autograd.grad((squared_error(predicted, true) * weight).sum(), (predicted, true))
    torch.testing.assert_close(of_fast, of_plain)
    torch.autograd.gradcheck(squared_error, (predicted, true))


def test_squared_errors_of_bfloat16_frames_are_computed_in_float32() -> None:
    generator = torch.Generator().manual_seed(0)
    true = torch.rand(2, 48, 8, 8, generator=generator)
    predicted = (true + 0.01 * torch.randn(true.shape, generator=generator)).bfloat16().requires_grad_()
    each = squared_error(predicted, true)
    wide = predicted.detach().float().requires_grad_()
    plain = (wide - true).square().flatten(1).mean(1)
    torch.testing.assert_close(each, plain, rtol=1e-6, atol=0)
    (of_plain,) = torch.autograd.grad(plain.sum(), wide)
    (of_fast,) = torch.autograd.grad(each.sum(), predicted)
    assert of_fast.dtype == torch.bfloat16
    torch.testing.assert_close(of_fast.float(), of_plain, rtol=2**-7, atol=0)
