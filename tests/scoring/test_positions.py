"""The finder finds what is drawn where it is drawn, and nothing else."""

from __future__ import annotations

import colorsys
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench import positions
from dmotion_bench.actions import Discrete
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import EnvSpec, ObjectSpec

from .conftest import write_dataset

COLORS = ((255, 0, 0), (0, 0, 255), (255, 255, 0), (255, 0, 255))


def spec_of(colors: tuple[tuple[int, int, int], ...], height: int = 128, width: int = 128) -> EnvSpec:
    things = tuple(ObjectSpec(name=str(color), shape="box", color=color) for color in colors)
    return EnvSpec(
        id="boxes",
        actions=Discrete(("stay",)),
        agent=ObjectSpec(name="agent", shape="box", color=(0, 255, 0)),
        objects=things,
        height=height,
        width=width,
    )


def slow_centres(frame: np.ndarray, colors: tuple[tuple[int, int, int], ...], least: int) -> np.ndarray:
    """Pixel by pixel, without a table: the nearest colour if it is near enough, then the mean place."""
    wanted = np.asarray(colors, float)
    apart = [np.linalg.norm(a - b) for i, a in enumerate(wanted) for b in wanted[:i]]
    limit = min([positions.COLOR_DISTANCE, *(distance / 2 for distance in apart)])
    places: list[list[tuple[int, int]]] = [[] for _ in colors]
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            distance = np.linalg.norm(wanted - frame[y, x], axis=1)
            if distance.min() <= limit:
                places[int(distance.argmin())].append((x, y))
    return np.array([np.mean(place, axis=0) if len(place) >= least else (np.nan, np.nan) for place in places])


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=15)
@given(
    boxes=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 40), st.integers(0, 24), st.integers(1, 9), st.integers(1, 9)),
        max_size=6,
    ),
    flip=st.booleans(),
)
def test_centres_are_those_of_a_pixel_by_pixel_search(boxes: list[tuple[int, int, int, int, int]], flip: bool) -> None:
    frame = np.zeros((32, 48, 3), np.uint8)
    for color, x, y, w, h in boxes:
        frame[y : y + h, x : x + w] = COLORS[color]
    frame[3, 5] = (120, 120, 120)
    finder = PositionFinder(spec_of(COLORS, 32, 48))
    frames = torch.from_numpy(np.stack([frame[:, ::-1] if flip else frame, frame]))

    found = finder.find(frames)

    expected = np.stack([slow_centres(one.numpy(), COLORS, finder.least_pixels) for one in frames])
    np.testing.assert_allclose(found.centre.numpy(), expected, atol=1e-4)
    np.testing.assert_array_equal(found.found.numpy(), np.isfinite(expected[..., 0]))


def test_a_sliver_is_not_an_object() -> None:
    finder = PositionFinder(spec_of(COLORS))
    frame = torch.zeros(128, 128, 3, dtype=torch.uint8)
    frame[:, :] = 0
    frame[10, 10 : 10 + finder.least_pixels - 1] = torch.tensor(COLORS[0], dtype=torch.uint8)

    assert not finder.find(frame).found.any()
    frame[11, 10] = torch.tensor(COLORS[0], dtype=torch.uint8)
    assert finder.find(frame).found.tolist() == [True, False, False, False]


@pytest.mark.parametrize("shaded", [False, True])
def test_of_things_of_one_colour_none_is_found_and_the_others_are(shaded: bool) -> None:
    frame = torch.zeros(1, 128, 128, 3, dtype=torch.uint8)
    frame[0, 20:30, 20:30] = torch.tensor((255, 0, 0))
    frame[0, 60:70, 60:70] = torch.tensor((0, 0, 255))
    twins = dataclasses.replace(spec_of(((255, 0, 0), (0, 0, 255), (255, 0, 0))), shaded=shaded)
    assert PositionFinder(twins).find(frame).found.tolist() == [[False, True, False]]


def test_shade_changes_no_hue_and_grey_has_none() -> None:
    colors = ((220, 40, 40), (40, 200, 60), (40, 60, 220), (230, 210, 30), (200, 40, 200), (40, 200, 210))
    finder = PositionFinder(dataclasses.replace(spec_of(colors), shaded=True))
    frame = np.full((128, 128, 3), (204, 184, 153), np.uint8)  # a wooden table
    for place, color in enumerate(colors):
        for step, light in enumerate((1.0, 0.7, 0.4)):
            frame[20 * place : 20 * place + 10, 10 + 5 * step : 15 + 5 * step] = np.asarray(color) * light
    frame[:, 100:] = 90

    found = finder.find(torch.from_numpy(frame))

    assert found.pixels.tolist() == [150] * 6
    assert found.centre.tolist() == [[17.0, 20.0 * place + 4.5] for place in range(6)]


def test_a_search_in_boxes_is_a_search_of_pictures_that_are_black_outside() -> None:
    generator = np.random.default_rng(4)
    frames = np.asarray((*COLORS, (0, 0, 0)), np.uint8)[generator.integers(0, 5, (6, 32, 48))]
    corners = np.sort(generator.uniform(-6, 54, (6, 4, 2, 2)), axis=2)
    finder = PositionFinder(spec_of(COLORS, 32, 48))
    low, high = (torch.from_numpy(corners[:, :, place]).float() for place in (0, 1))
    high[0, 1], low[3, 2] = torch.nan, torch.nan
    found, extents = finder.find_within(torch.from_numpy(frames), low, high)
    ys, xs = np.mgrid[:32, :48]
    for one in range(6):
        for color in range(4):
            (x, y), (to_x, to_y) = low[one, color].tolist(), high[one, color].tolist()
            inside = (xs >= x) & (xs <= to_x) & (ys >= y) & (ys <= to_y)
            cut = torch.from_numpy(frames[one] * inside[..., None].astype(np.uint8))[None]
            alone, whole = finder.find_extents(cut)
            assert found.pixels[one, color] == alone.pixels[0, color]
            torch.testing.assert_close(found.centre[one, color], alone.centre[0, color], equal_nan=True)
            torch.testing.assert_close(extents[one, color], whole[0, color], equal_nan=True)
    assert 0 < found.found.sum() < 24


def test_things_of_one_pixel_and_lines_extend_over_their_pixels_in_a_small_picture() -> None:
    frame = torch.zeros(1, 10, 12, 3, dtype=torch.uint8)
    for color, place in zip(COLORS[:3], ((3, 7), (5, slice(2, 6)), (slice(6, 9), 10)), strict=True):
        frame[0][place] = torch.tensor(color, dtype=torch.uint8)
    frame[0, 1:3, 0:3] = torch.tensor(COLORS[3], dtype=torch.uint8)
    frame[0, 9, 0] = torch.tensor(COLORS[3], dtype=torch.uint8)  # a stray one
    _, extents = PositionFinder(spec_of(COLORS, 10, 12)).find_extents(frame)
    assert extents[0].tolist() == [[[7, 7], [3, 3]], [[2, 5], [5, 5]], [[10, 10], [6, 8]], [[0, 2], [1, 2]]]


def test_boxes_for_more_colours_than_a_word_has_fields() -> None:
    hues = [colorsys.hsv_to_rgb(place / 12, 1, 1) for place in range(12)]
    colors = tuple(tuple(round(255 * part) for part in hue) for hue in hues)
    frames = torch.tensor(colors, dtype=torch.uint8).repeat(1, 30, 2, 1)
    finder = PositionFinder(spec_of(colors, 30, 24))
    low = torch.tensor([[0.0, 0.0]] * 5 + [[12.0, 0.0]] * 5)[None]
    high = torch.tensor([[11.0, 29.0]] * 5 + [[23.0, 29.0]] * 5)[None]
    found, _ = finder.find_within(frames, low, high)
    assert found.centre[0].tolist() == [[place + 12.0 * (place >= 5), 14.5] for place in range(10)]


def test_the_way_of_a_gpu_counts_the_same() -> None:
    frames = torch.randint(0, 256, (5, 128, 128, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    word = torch.randint(0, 2**40, (32**3,), generator=torch.Generator().manual_seed(1))

    here, there = positions._sums_on_cpu(frames, word), positions._sums_on_device(frames, word)

    assert all(torch.equal(a, b) for a, b in zip(here, there, strict=True))


def test_more_colours_than_a_word_has_fields() -> None:
    hues = [colorsys.hsv_to_rgb(place / 12, 1, 1) for place in range(12)]
    colors = tuple(tuple(round(255 * part) for part in hue) for hue in hues)
    frame = torch.zeros(128, 300, 3, dtype=torch.uint8)
    for place, color in enumerate(colors):
        frame[40:60, 25 * place : 25 * place + 20] = torch.tensor(color, dtype=torch.uint8)

    found = PositionFinder(spec_of(colors, 128, 300)).find(frame)

    assert found.centre.tolist() == [[25 * place + 9.5, 49.5] for place in range(12)]


def test_any_leading_axes() -> None:
    frames = torch.randint(0, 256, (2, 3, 128, 128, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    finder = PositionFinder(spec_of(COLORS))

    nested, flat = finder.find(frames), finder.find(frames.flatten(0, 1))

    torch.testing.assert_close(nested.centre.flatten(0, 1), flat.centre, equal_nan=True, rtol=0, atol=0)
    assert nested.found.shape == (2, 3, 4)


@pytest.mark.parametrize("version", [1, 2])
def test_finds_what_grid_world_says_is_there(tmp_path: Path, version: int) -> None:
    grid = write_dataset(tmp_path / "grid", episodes=4, version=version)
    finder = PositionFinder(grid.spec)
    for episode in range(4):
        labels = grid.labels(episode)
        found = finder.find(torch.from_numpy(grid.video(episode)))

        places = np.concatenate([labels.objects.pixel, labels.agent.pixel], axis=1)
        there = np.concatenate([labels.objects.visible, labels.agent.visible], axis=1) > 0
        np.testing.assert_array_equal(found.found.numpy(), there)
        np.testing.assert_allclose(found.centre.numpy()[there], places[there], atol=1e-3)


def test_nothing_to_look_for() -> None:
    with pytest.raises(ValueError, match="no positions"):
        PositionFinder(spec_of(())).find(torch.zeros(1, 16, 16, 3, dtype=torch.uint8))
