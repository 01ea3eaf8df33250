"""The shared layers against torch's own."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from baselines.layers import (
    LARGEST_FLOW,
    WIDTHS,
    RoundConv2d,
    UNet,
    UNetConfig,
    conv,
    over_frames,
    squared_error,
    up,
    warped,
)
from baselines.patches import CHANNELS, PATCH, from_patches, pack, patches, unpack
from dmotion_bench.errors import InvalidSetting


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


def test_warping_reads_each_pixel_where_the_flow_points() -> None:
    image = torch.rand(2, 3, 16, 24, generator=torch.Generator().manual_seed(0))
    flow = torch.zeros(2, 2, 4, 6)
    flow[0, 0], flow[1, 1] = 3, -2  # the first from the right, the second from above
    moved = warped(image, flow)
    torch.testing.assert_close(moved[0, :, :, :-3], image[0, :, :, 3:])
    torch.testing.assert_close(moved[0, :, :, -3:], image[0, :, :, -1:].expand(-1, -1, 3))
    torch.testing.assert_close(moved[1, :, 2:], image[1, :, :-2])


def test_a_u_net_that_warps_can_carry_the_frame_without_painting() -> None:
    network = UNet(1, UNetConfig(warp=True))
    with torch.no_grad():
        for layer in (network.flow, network.warp_gate, network.gate):
            layer.weight.zero_()
        network.flow.bias.copy_(torch.tensor([1.0, 0.0]))
        network.warp_gate.bias.fill_(50)
        network.gate.bias.fill_(-50)
    image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    carried = unpack(network.next_frame([pack(image)], torch.zeros(1, WIDTHS[0], 1, 1)))
    flow = torch.tensor([LARGEST_FLOW * math.tanh(PATCH / LARGEST_FLOW), 0.0]).reshape(1, 2, 1, 1)
    torch.testing.assert_close(carried, warped(image, flow), atol=1e-5, rtol=1e-5)
    assert network.painting.out_channels == CHANNELS


def test_warping_adds_a_flow_and_its_gate_to_what_paints() -> None:
    names = set(UNet(2).state_dict())
    assert {name for name in UNet(2, UNetConfig(warp=True)).state_dict() if name not in names} == {
        f"{layer}.{kind}" for layer in ("flow", "warp_gate") for kind in ("weight", "bias")
    }


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


def test_a_gate_lets_in_one_share_per_pixel_for_all_colours() -> None:
    generator = torch.Generator().manual_seed(0)
    network = UNet(1).double()
    packed = torch.randn(2, CHANNELS, 8, 8, generator=generator, dtype=torch.float64)
    seen: list[Tensor] = []
    network.merge0.register_forward_hook(lambda _, __, features: seen.append(features))
    blended = network.next_frame([packed], torch.zeros(2, WIDTHS[0], 1, 1))
    weight = torch.randn(blended.shape, generator=generator, dtype=torch.float64)
    parameters = [*network.painting.parameters(), *network.gate.parameters()]
    of_blended = torch.autograd.grad((blended * weight).sum(), parameters)
    features = seen[0].detach()

    share = torch.sigmoid(network.gate(features) - 1).repeat(1, 3, 1, 1)
    plain = packed + share * (network.painting(features) - packed)
    torch.testing.assert_close(blended, plain)
    torch.testing.assert_close(of_blended, torch.autograd.grad((plain * weight).sum(), parameters))


def _closed(floor: float) -> tuple[UNet, Tensor, Tensor]:
    """A network whose gate is closed everywhere, what it predicts of noise, and by how much its painting differs."""
    torch.manual_seed(0)
    network = UNet(1, UNetConfig(gate_floor=floor))
    assert network.gate.bias is not None
    torch.nn.init.constant_(network.gate.bias, -300.0)
    packed, seen = pack(torch.rand(2, 3, 32, 32) * 2 - 1), []
    with network.painting.register_forward_hook(lambda _m, _i, output: seen.append(output.detach())):
        predicted = network.next_frame([packed], torch.zeros(2, WIDTHS[0], 1, 1))
    return network, predicted - packed, seen[0] - packed


def test_a_gate_that_closed_everywhere_learns_nothing_and_with_a_floor_opens_again() -> None:
    network, change, _ = _closed(0.0)
    change.square().sum().backward()
    assert not any(value.grad.any() for value in network.parameters() if value.grad is not None)

    for wanted, opens in ((-1, False), (1, True)):  # the painting is to be kept out, or to be let in
        network, change, difference = _closed(0.01)
        torch.testing.assert_close(change, 0.01 * difference, atol=1e-6, rtol=1e-3)
        change.backward(-wanted * difference)
        assert network.painting.weight.grad is not None
        assert network.painting.weight.grad.any()
        assert network.gate.bias is not None
        assert network.gate.bias.grad is not None
        assert (network.gate.bias.grad < 0).all() if opens else not network.gate.bias.grad.any()


@pytest.mark.parametrize("floor", [-0.1, 1.0, float("nan")])
def test_a_floor_that_cannot_be_is_refused(floor: float) -> None:
    with pytest.raises(InvalidSetting, match="gate_floor is"):
        UNetConfig(gate_floor=floor)


def test_a_wider_network_has_wider_layers_and_the_same_in_and_out() -> None:
    usual, wide = UNet(2), UNet(2, UNetConfig(width=2))
    assert wide.widths == [2 * channels for channels in usual.widths]
    packed = pack(torch.rand(3, 3, 32, 32))
    for network in (usual, wide):
        assert network.next_frame([packed, packed], torch.zeros(3, network.widths[0], 1, 1)).shape == packed.shape
    assert wide.middle[0][0].weight.numel() == 4 * usual.middle[0][0].weight.numel()


def test_a_network_without_channels_is_refused() -> None:
    with pytest.raises(InvalidSetting, match="width is 0"):
        UNetConfig(width=0)
