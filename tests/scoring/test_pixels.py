"""Pixel figures against plain implementations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.scoring.pixels import (
    PSNR_CAP,
    mean_squared_error,
    peak_signal_to_noise,
    structural_similarity,
)


@pytest.fixture
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures that are alike in some places: noise, faint noise, an edge, one flat against noise."""
    generator = np.random.default_rng(0)
    truth = generator.integers(0, 256, (5, 40, 33, 3))
    truth[1], truth[2, :, :16], truth[2, :, 16:] = 0, 10, 240
    near = truth + generator.integers(-9, 10, truth.shape)
    near[3], near[4] = 128, truth[4]
    stacked = [torch.from_numpy(frames.clip(0, 255).astype(np.uint8)) for frames in (near, truth)]
    return stacked[0], stacked[1]


def plain_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004 as it is written, with scipy's Gaussian, in double precision."""

    def smooth(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, 1.5, truncate=3.5)[5:-5, 5:-5]  # radius 5: an 11 x 11 window

    figures = []
    for channel in range(3):
        a, b = x[..., channel].astype(float), y[..., channel].astype(float)
        mean_a, mean_b = smooth(a), smooth(b)
        var_a, var_b = smooth(a * a) - mean_a**2, smooth(b * b) - mean_b**2
        covariance = smooth(a * b) - mean_a * mean_b
        c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
        top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
        figures.append((top / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean())
    return float(np.mean(figures))


def test_ssim_is_wangs(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    predicted, truth = pair

    expected = [plain_ssim(x, y) for x, y in zip(predicted.numpy(), truth.numpy(), strict=True)]

    np.testing.assert_allclose(structural_similarity(predicted, truth).numpy(), expected, atol=2e-5)


def test_ssim_of_the_same_is_one_and_has_no_direction(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    predicted, truth = pair

    assert structural_similarity(truth, truth).tolist() == [1.0] * 5
    torch.testing.assert_close(
        structural_similarity(predicted, truth), structural_similarity(truth, predicted), rtol=0, atol=1e-6
    )


def test_ssim_is_computed_in_float32_where_models_predict_in_less(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    expected = structural_similarity(*pair)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(structural_similarity(*pair), expected, rtol=0, atol=0)


def test_ssim_needs_a_window() -> None:
    with pytest.raises(InvalidSetting, match="11 x 11"):
        structural_similarity(*torch.zeros(2, 1, 10, 40, 3, dtype=torch.uint8))


def test_mse_is_the_mean_of_exact_squares(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    predicted, truth = pair

    squares = (predicted.numpy().astype(np.int64) - truth.numpy()) ** 2

    np.testing.assert_array_equal(mean_squared_error(predicted, truth).numpy(), squares.reshape(5, -1).mean(1))


def test_psnr_of_one_grey_level_and_of_nothing() -> None:
    # a frame that is off by 1 everywhere has the MSE 1: 20 log10(255) = 48.13 dB
    mse = torch.tensor([1.0, 0.0, 255.0**2], dtype=torch.float64)

    np.testing.assert_allclose(peak_signal_to_noise(mse).numpy(), [48.1308, PSNR_CAP, 0.0], atol=1e-4)


@pytest.mark.parametrize(("side", "reached"), [(128, False), (226, False), (227, True)])
def test_frames_that_differ_in_one_number_reach_the_cap_from_a_size_on(side: int, reached: bool) -> None:
    least = torch.tensor([1 / (side * side * 3)], dtype=torch.float64)

    assert (peak_signal_to_noise(least).item() == PSNR_CAP) == reached
