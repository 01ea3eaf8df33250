"""The background: its textures look natural and have no seam, and it scrolls as far as it says."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from recorders.distractors.background import Blend, Textures, muted
from recorders.distractors.streams import stream
from recorders.distractors.textures import GENERATORS, TILE, texture


def test_the_background_scrolls_as_far_as_is_told() -> None:
    """Its front plane's middle parts, held against the picture moved by what is told, where no hole is in either."""
    planes = Textures(stream(3, "background", 0), "leaves", size=128, share=1.0)
    black = np.zeros((128, 128, 3), np.uint8)
    for moment in range(6):
        one, other = (planes.lay(black, at, (0, 0)) for at in (moment, moment + 1))
        back, front = planes.moved(moment, moment + 1).reshape(2, 2).astype(int)
        inner = (slice(16, -16), slice(16, -16))
        followed = [(np.roll(one, (y, x), axis=(0, 1)) == other)[inner].all(axis=-1) for x, y in ((*back,), (*front,))]
        assert (followed[0] | followed[1]).mean() > 0.9  # each pixel is of one of the two planes
        assert min(one.mean() for one in followed) > 0.1


def test_textures_differ_between_generators_have_no_seam_and_are_the_same_again() -> None:
    for one, other in itertools.combinations(GENERATORS, 2):
        assert (texture(one, 0) != texture(other, 0)).mean() > 0.5
    for kind in GENERATORS:
        shades = texture(kind, 1).astype(int)
        assert shades.shape == (TILE, TILE)
        assert np.ptp(shades) > 200
        inside = np.abs(np.diff(shades, axis=1)).mean()
        across = np.abs(shades[:, 0] - shades[:, -1]).mean()
        assert across < 3 * inside + 5  # the first and the last column are neighbours
        texture.cache_clear()
        np.testing.assert_array_equal(texture(kind, 1), shades)
        assert (texture(kind, 2) != shades).mean() > 0.5


def test_leaves_and_clouds_have_the_spectrum_of_natural_pictures() -> None:
    """Power that falls by about the square of the frequency; white noise has a slope of 0."""
    for kind in ("leaves", "clouds"):
        pictures = [texture(kind, number) - texture(kind, number).mean() for number in range(4)]
        power = np.mean([np.abs(np.fft.fft2(picture)) ** 2 for picture in pictures], axis=0)
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(TILE), np.fft.fftfreq(TILE)))
        edges = np.geomspace(4 / TILE, 0.25, 10)
        rings = [power[(frequency >= low) & (frequency < high)].mean() for low, high in itertools.pairwise(edges)]
        slope = np.polyfit(np.log(edges[1:] * edges[:-1]) / 2, np.log(rings), 1)[0]
        assert -3.1 < slope < -1.6, kind


def test_a_blend_is_the_weighted_mean() -> None:
    lower, upper = np.random.default_rng(0).integers(256, size=(2, 500)).astype(np.uint8)
    for share in (0.0, 0.25, 0.7, 1.0):
        blend = Blend(share)
        mixed = blend.mixed(lower, blend.faded(upper)).astype(float)
        assert np.abs(mixed - (1 - share) * lower - share * upper).max() <= 1.6
    blend = Blend(0.5)
    white = np.full(4, 255, np.uint8)
    assert (blend.mixed(white, blend.faded(white)) == 255).all()


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (255, 0, 0), (3, 200, 250), (1, 1, 0)])
def test_muted_colours_keep_their_order_and_lose_their_strength(color: tuple[int, int, int]) -> None:
    pale = muted(np.array(color, np.uint8)).astype(int)
    assert pale.max() >= 110
    assert (pale.max() - pale.min()) / pale.max() <= 0.34
    assert all(pale[one] >= pale[other] for one in range(3) for other in range(3) if color[one] > color[other])
