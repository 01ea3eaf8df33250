"""Feature maps as tiles: every pixel where it belongs, all in one unit."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.viewing.maps import GAP, GAP_LEVEL, brightest, tile_corners, tiles


@settings(deadline=None, derandomize=True, max_examples=30)
@given(count=st.integers(1, 9), height=st.integers(1, 6), width=st.integers(1, 6), seed=st.integers(0, 99))
def test_a_tile_is_its_map(count: int, height: int, width: int, seed: int) -> None:
    maps = np.random.default_rng(seed).normal(size=(2, count, height, width)).astype(np.float32)
    sheet, white = tiles(maps, 2.0), 2.0
    covered = np.zeros(sheet.shape[1:], bool)
    for number, (top, left) in enumerate(tile_corners(count, height, width)):
        place = (slice(top, top + height), slice(left, left + width))
        expected = np.minimum(np.abs(maps[:, number]) * (255 / white), 255).astype(np.uint8)
        np.testing.assert_array_equal(sheet[:, *place], expected)
        assert not covered[place].any()
        covered[place] = True
    assert (sheet[:, ~covered] == GAP_LEVEL).all()
    assert not covered[:GAP].any()


def test_one_unit_for_all_maps() -> None:
    quiet, loud = np.full((1, 1, 4, 4), 0.5), np.full((1, 1, 4, 4), -2.0)
    white = brightest(quiet, loud)
    assert white == 2.0
    assert tiles(loud, white)[0, GAP, GAP] == 255
    assert tiles(quiet, white)[0, GAP, GAP] == 63


def test_maps_of_zeros_are_black() -> None:
    nothing = np.zeros((1, 2, 3, 3))
    assert tiles(nothing, brightest(nothing))[0, GAP, GAP] == 0
