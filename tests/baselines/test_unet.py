"""The U-Net: its gates, its flow and its width."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from baselines.layers import WIDTHS
from baselines.patches import CHANNELS, PATCH, pack, unpack
from baselines.unet import LARGEST_FLOW, UNet, UNetConfig, warped
from dmotion_bench.errors import InvalidSetting


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
