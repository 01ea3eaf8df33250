"""The transforms against whole-pixel rolls, torch's own sampling, and finite differences."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from baselines.motion import AffineMotion, CrossConvolution, Translation, pixel_shift, theta_of_shift


def _maps(size: int = 17, maps: int = 2, batch: int = 3) -> torch.Tensor:
    return torch.rand(batch, maps, size, size, generator=torch.Generator().manual_seed(0))


def _as_affine(shift: torch.Tensor) -> torch.Tensor:
    one, zero = torch.ones_like(shift[..., 0]), torch.zeros_like(shift[..., 0])
    return torch.stack([one, zero, shift[..., 0], zero, one, shift[..., 1]], dim=-1)


@given(dx=st.integers(-3, 3), dy=st.integers(-3, 3))
@settings(deadline=None, derandomize=True)
def test_whole_pixel_motion_is_a_roll(dx: int, dy: int) -> None:
    maps = _maps()
    theta = theta_of_shift(torch.tensor([float(dx), float(dy)]), 17).expand(3, 2, 2)
    inner = (..., slice(3, -3), slice(3, -3))  # the border samples zeros, not the far side
    rolled = maps.roll((dy, dx), dims=(-2, -1))[inner]
    torch.testing.assert_close(Translation()(maps, theta)[inner], rolled, atol=1e-3, rtol=0)
    torch.testing.assert_close(AffineMotion()(maps, _as_affine(theta))[inner], rolled, atol=1e-5, rtol=0)


def test_translation_is_the_affine_warp_in_value_and_gradient() -> None:
    generator = torch.Generator().manual_seed(1)
    maps = _maps(33).double().float().requires_grad_()
    shift = (torch.rand(3, 2, 2, generator=generator) - 0.5).requires_grad_()
    weight = torch.rand(3, 2, 33, 33, generator=generator)
    fast, slow = Translation()(maps, shift), AffineMotion()(maps, _as_affine(shift))
    torch.testing.assert_close(fast, slow, atol=1e-4, rtol=1e-4)
    of_fast = torch.autograd.grad((fast * weight).sum(), (maps, shift), retain_graph=True)
    of_slow = torch.autograd.grad((slow * weight).sum(), (maps, shift))
    torch.testing.assert_close(of_fast[0], of_slow[0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(of_fast[1], of_slow[1], atol=1e-2, rtol=1e-3)


def test_the_gradient_is_that_of_finite_differences_with_a_wide_kernel_too() -> None:
    maps = _maps(21)
    shift = torch.full((3, 2, 2), 0.123).requires_grad_()
    step = 1e-3
    for blur in (1.0, 5.0):
        (slope,) = torch.autograd.grad(Translation()(maps, shift, blur).square().sum(), shift)
        numeric = torch.zeros_like(shift)
        for place in torch.cartesian_prod(torch.arange(3), torch.arange(2), torch.arange(2)):
            moved = torch.zeros_like(shift)
            moved[tuple(place)] = step
            up = Translation()(maps, (shift + moved).detach(), blur).square().sum()
            down = Translation()(maps, (shift - moved).detach(), blur).square().sum()
            numeric[tuple(place)] = (up - down) / (2 * step)
        torch.testing.assert_close(slope, numeric, atol=0.2, rtol=0.02)


def test_no_motion_has_a_gradient() -> None:
    """At rest the hat function has a kink; a symmetric derivative would never start to move."""
    shift = torch.zeros(1, 1, 2, requires_grad=True)
    ramp = torch.arange(17.0).expand(1, 1, 17, 17)
    (slope,) = torch.autograd.grad(Translation()(ramp, shift)[..., :8].sum(), shift)
    assert slope[0, 0, 0].abs() > 1


def test_moving_right_is_a_negative_translation() -> None:
    dot = torch.zeros(1, 1, 17, 17)
    dot[..., 8, 8] = 1
    moved = Translation()(dot, theta_of_shift(torch.tensor([[[4.0, 0.0]]]), 17))
    assert moved[0, 0, 8, 12] > 0.99
    assert theta_of_shift(torch.tensor([4.0, 0.0]), 17)[0] < 0
    torch.testing.assert_close(
        pixel_shift(theta_of_shift(torch.tensor([4.0, -2.0]), 17), 17), torch.tensor([4.0, -2.0])
    )


def test_a_grid_cell_is_the_shift_that_the_facts_say() -> None:
    torch.testing.assert_close(
        theta_of_shift(torch.tensor([-12.8, 0]), 64), torch.tensor([0.406, 0]), atol=1e-3, rtol=0
    )


def test_identities_leave_maps_alone() -> None:
    maps = _maps()
    for transform in (Translation(), AffineMotion(), CrossConvolution(5)):
        motion = transform.identity().expand(3, 2, transform.size)
        torch.testing.assert_close(transform(maps, motion), maps, atol=1e-3, rtol=0)


def test_cross_convolution_moves_each_map_by_its_own_kernel() -> None:
    maps = _maps()
    kernels = torch.zeros(3, 2, 25)
    kernels[:, 0, 2 * 5 + 1] = 1  # reads one pixel to the left: moves right
    kernels[:, 1, 4 * 5 + 2] = 1  # reads two pixels below: moves up
    moved = CrossConvolution(5)(maps, kernels)
    torch.testing.assert_close(moved[:, 0, :, 1:], maps[:, 0, :, :-1])
    torch.testing.assert_close(moved[:, 1, :-2], maps[:, 1, 2:])


def test_large_kernels_in_fourier_space_are_the_same_sum() -> None:
    generator = torch.Generator().manual_seed(2)
    maps, kernels = _maps(21), torch.randn(3, 2, 13 * 13, generator=generator)
    padded = torch.nn.functional.pad(maps, (6, 6, 6, 6))
    windows = padded.unfold(-2, 13, 1).unfold(-2, 13, 1)  # b k h w i j
    expected = (windows * kernels.reshape(3, 2, 1, 1, 13, 13)).sum((-2, -1))
    torch.testing.assert_close(CrossConvolution(13)(maps, kernels), expected, atol=1e-4, rtol=1e-4)
