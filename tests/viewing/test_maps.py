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
    white = np.linspace(1, 2, count)
    sheet = tiles(maps, white)
    covered = np.zeros(sheet.shape[1:], bool)
    for number, (top, left) in enumerate(tile_corners(count, height, width)):
        place = (slice(top, top + height), slice(left, left + width))
        expected = np.minimum(np.abs(maps[:, number]) * (255 / white[number]), 255).astype(np.uint8)
        np.testing.assert_array_equal(sheet[:, *place], expected)
        assert not covered[place].any()
        covered[place] = True
    assert (sheet[:, ~covered] == GAP_LEVEL).all()
    assert not covered[:GAP].any()


def test_a_map_has_one_unit_before_and_after_it_moves() -> None:
    before, after = np.full((2, 1, 4, 4), 0.5), np.full((2, 1, 4, 4), -2.0)
    white = brightest(before, after)
    assert white.tolist() == [2.0]
    assert tiles(after, white)[0, GAP, GAP] == 255
    assert tiles(before, white)[0, GAP, GAP] == 63


def test_a_faint_map_is_as_bright_as_another_but_nothing_is_not_made_something() -> None:
    maps = np.ones((1, 3, 4, 4)) * np.array([1.0, 0.1, 1e-6])[:, None, None]
    sheet = tiles(maps, brightest(maps))
    shown = [sheet[0, top, left] for top, left in tile_corners(3, 4, 4)]
    assert shown == [255, 255, 0]


def test_maps_of_zeros_are_black() -> None:
    nothing = np.zeros((1, 2, 3, 3))
    assert tiles(nothing, brightest(nothing))[0, GAP, GAP] == 0
