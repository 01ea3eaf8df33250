"""The shift that explains best what changes: known ones, a sum over pixels written out, and recorded episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from baselines.dominant_shift import REACH, _left_unexplained, dominant_shift
from dmotion_bench.recording.rollout import record_episode
from recorders.grid_world import GridWorld

SIDE = 64


def thing(x: int, y: int, side: int = 9, seed: int = 0) -> Tensor:
    """A textured square on grey; what is outside of the picture is cut off."""
    texture = torch.rand(3, side, side, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    wide = torch.full((3, 3 * SIDE, 3 * SIDE), 0.2)
    wide[:, SIDE + y : SIDE + y + side, SIDE + x : SIDE + x + side] = texture
    return wide[:, SIDE : 2 * SIDE, SIDE : 2 * SIDE]


@settings(deadline=None, derandomize=True, max_examples=12)
@given(x=st.integers(-18, 18), y=st.integers(-18, 18))
def test_a_thing_that_moves_before_a_plain_background_is_found_exactly(x: int, y: int) -> None:
    found = dominant_shift(thing(28, 28)[None], thing(28 + x, 28 + y)[None])
    if (x, y) == (0, 0):
        assert found.confidence.tolist() == [0]
    else:
        np.testing.assert_allclose(found.pixels[0], (x, y), atol=0.3)
        assert found.confidence.item() > 0.4  # what it would come from beyond the edge is not seen


@pytest.mark.parametrize(
    ("place", "shift"), [((0, 0), (12, 0)), ((0, 0), (0, 12)), ((55, 55), (-12, 0)), ((0, 30), (0, 12))]
)
def test_a_thing_that_stands_at_an_edge_is_found(place: tuple[int, int], shift: tuple[int, int]) -> None:
    """What it uncovers came from outside the picture: one of the two sums cannot explain it, the other can."""
    before, after = thing(*place), thing(place[0] + shift[0], place[1] + shift[1])
    there, back = dominant_shift(before[None], after[None]), dominant_shift(after[None], before[None])
    np.testing.assert_allclose(there.pixels[0], shift, atol=0.1)
    np.testing.assert_allclose(back.pixels, -there.pixels, atol=1e-4)
    torch.testing.assert_close(there.confidence, back.confidence)


@pytest.mark.parametrize("shift", [19, 20, 21])
def test_no_shift_is_larger_than_those_that_are_looked_for(shift: int) -> None:
    """Beyond the window's edge nothing is known, so nothing is refined there."""
    found = dominant_shift(thing(20, 28)[None], thing(20 + shift, 28)[None])
    assert abs(found.pixels).max() <= round(REACH * SIDE)


def test_what_is_pushed_along_moves_by_the_same_shift() -> None:
    def scene(x: int) -> Tensor:
        return torch.maximum(thing(10 + x, 20), thing(19 + x, 20, seed=1))

    np.testing.assert_allclose(dominant_shift(scene(0)[None], scene(9)[None]).pixels[0], (9, 0), atol=0.1)


def test_larger_frames_are_reduced_and_their_shifts_are_in_their_own_pixels() -> None:
    small = torch.stack([thing(20, 20), thing(33, 12)])[:, None]
    large = small.repeat_interleave(2, -1).repeat_interleave(2, -2)
    np.testing.assert_allclose(dominant_shift(*large).pixels[0], (26, -16), atol=0.2)


def test_nothing_is_said_where_nothing_or_everything_changes() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(2, 1, 3, SIDE, SIDE, generator=generator)
    assert dominant_shift(noise[0], noise[0]).confidence.item() == 0
    assert dominant_shift(noise[0], noise[1]).confidence.item() == 0


@pytest.mark.parametrize("distracting", [{"movers": 3}, {"shake": 2}, {"noise": 4.0}, {"scene": "distracted"}])
def test_pale_things_that_move_by_themselves_hide_the_agent_seldom(distracting: dict[str, Any]) -> None:
    assert np.mean(errors_in_grid_world(1, **distracting) < 2) > 0.8


def test_the_spectra_come_to_the_sum_over_pixels() -> None:
    generator = torch.Generator().manual_seed(3)
    one, other = torch.rand(2, 1, 3, 11, 11, generator=generator).double()
    change = (other - one).square().sum(1, keepdim=True)
    reach = 3
    found = _left_unexplained(one, other, change, reach)[0]
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            total = 0.0
            for (here, there), way in (((other, one), 1), ((one, other), -1)):
                for y in range(11):
                    for x in range(11):
                        v, u = y - way * down, x - way * right
                        inside = 0 <= v < 11 and 0 <= u < 11
                        distance = (here[0, :, y, x] - (there[0, :, v, u] if inside else there[0, :, y, x])).square()
                        total += float(change[0, 0, y, x] * distance.sum())
            assert found[reach + down, reach + right] == pytest.approx(total, rel=1e-9)


def test_in_grid_world_it_is_the_agents_shift() -> None:
    assert np.mean(errors_in_grid_world(3) < 1) > 0.9


def errors_in_grid_world(episodes: int, **settings: Any) -> np.ndarray:
    env, errors = GridWorld(**settings), list[float]()
    for seed in range(episodes):
        episode = record_episode(env, env.policies[env.default_policy](), seed, 20)
        frames = torch.from_numpy(episode.frames).permute(0, 3, 1, 2).float() / 127.5 - 1
        shift = dominant_shift(frames[:-1], frames[1:]).pixels.numpy()
        errors += np.linalg.norm(shift - np.diff(episode.labels.agent.pixel[:, 0], axis=0), axis=1).tolist()
    return np.asarray(errors)
