"""The cost of a future: the paper's formula by hand, and what stands in for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from planning.worlds import PerfectGridModel

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.planning.costs import FeatureCost, PixelCost, PositionCost, make_cost
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import EnvSpec, ObjectSpec
from recorders.grid_world import FACTS, OBJECTS, draw


def pictures(*cells: list[tuple[int, int] | None]) -> torch.Tensor:
    """Grid World frames of agent and objects on these cells; None for one that is gone."""
    places = np.array([[cell or (0, 0) for cell in one] for one in cells])
    there = np.array([[cell is not None for cell in one] for one in cells])
    return torch.from_numpy(draw(places, there)[0])


HOME: list[tuple[int, int] | None] = [(0, 0), (1, 1), (3, 1), (1, 3), (3, 3)]
FIRST = torch.zeros(1, dtype=torch.long)


def test_the_papers_cost_is_the_sum_of_squared_distances_of_object_centres() -> None:
    moved = [(4, 4), (2, 1), (3, 1), (1, 4), (3, 3)]
    cost = PositionCost(FACTS, pictures(HOME))
    centre = PositionFinder(FACTS).find(pictures(HOME, moved)).centre[:, :OBJECTS]
    by_hand = float((centre[0] - centre[1]).square().sum())
    assert cost.of_frames(pictures(moved), FIRST).item() == pytest.approx(by_hand)
    assert by_hand == pytest.approx(25.6**2 + 25.6**2, rel=0.03)
    assert cost.of_frames(pictures(HOME), FIRST).item() == 0
    assert cost.of_frames(pictures([(4, 0), *HOME[1:]]), FIRST).item() == 0  # the agent does not count


def test_a_missing_object_costs_a_fixed_distance_and_one_that_the_goal_lacks_nothing() -> None:
    gone: list[tuple[int, int] | None] = [HOME[0], None, *HOME[2:]]
    assert PositionCost(FACTS, pictures(HOME)).of_frames(pictures(gone), FIRST).item() == 64**2
    assert PositionCost(FACTS, pictures(HOME), missing=7).of_frames(pictures(gone), FIRST).item() == 49
    assert PositionCost(FACTS, pictures(gone)).of_frames(pictures(HOME), FIRST).item() == 0


def test_each_frame_is_compared_with_the_goal_of_its_task() -> None:
    other = [(0, 0), (1, 2), (3, 1), (1, 3), (3, 3)]
    cost = PositionCost(FACTS, pictures(HOME, other))
    found = cost.of_frames(pictures(HOME, HOME, other, other), torch.tensor([0, 1, 0, 1]))
    assert (found == 0).tolist() == [True, False, False, True]


def test_pixels_and_features_can_stand_in() -> None:
    model, generator = PerfectGridModel(), torch.Generator().manual_seed(0)
    goals = torch.randint(0, 256, (2, 128, 128, 3), generator=generator, dtype=torch.uint8)
    image = torch.rand(3, 3, 128, 128, generator=generator) * 2 - 1
    task = torch.tensor([0, 1, 1])
    wanted = goals.float().mul(2 / 255).sub(1).permute(0, 3, 1, 2)[task]
    by_hand = (image - wanted).square().mean((1, 2, 3))
    torch.testing.assert_close(PixelCost(goals)(model, (image, image), task), by_hand)
    torch.testing.assert_close(FeatureCost(model, goals)(model, (image, image), task), by_hand)


class Knowing(PerfectGridModel):
    """Says what matters of its states: the mean colour of the last image."""

    def features(self, state: Any) -> torch.Tensor:
        return state[1].mean((2, 3))


def test_a_model_may_say_what_matters() -> None:
    model = Knowing()
    goals = pictures(HOME)
    state = model.begin(torch.full((1, 3, 128, 128), -1.0), torch.full((1, 3, 128, 128), -1.0))
    mean = goals.float().mul(2 / 255).sub(1).mean((1, 2))
    wanted = (mean + 1).square().mean(1)
    torch.testing.assert_close(FeatureCost(model, goals)(model, state, FIRST), wanted)


class Blind(PerfectGridModel):
    """Draws nothing that looks like a frame."""

    needs_pixels = False


def test_the_cost_that_suits_the_model_is_chosen() -> None:
    goals = pictures(HOME)
    assert isinstance(make_cost(None, PerfectGridModel(), FACTS, goals, goals), PositionCost)
    assert isinstance(make_cost(None, Blind(), FACTS, goals, goals), FeatureCost)
    assert isinstance(make_cost("pixel", PerfectGridModel(), FACTS, goals, goals), PixelCost)
    nothing = EnvSpec(
        id="empty", actions=Discrete(("go",)), agent=ObjectSpec(name="a", shape="dot", color=(0, 0, 0)), objects=()
    )
    assert isinstance(make_cost(None, PerfectGridModel(), nothing, goals, goals), FeatureCost)
    with pytest.raises(InvalidSetting, match="'empty' has no coloured objects to find"):
        make_cost("position", PerfectGridModel(), nothing, goals, goals)
    with pytest.raises(UnknownName, match="did you mean 'pixel'"):
        make_cost("pixels", PerfectGridModel(), FACTS, goals, goals)
