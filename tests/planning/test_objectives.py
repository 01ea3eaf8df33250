"""The cost of a future: the paper's formula by hand, and what stands in for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from planning.worlds import PerfectGridModel

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.temporal_distance import TemporalDistance, TemporalDistanceConfig
from dmotion_bench.planning.choices import make_objective
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.objectives.base import Evaluator, StepCost
from dmotion_bench.planning.objectives.centres import Centres, CentresEvaluator
from dmotion_bench.planning.objectives.feature import Feature
from dmotion_bench.planning.objectives.pixel import Pixel
from dmotion_bench.planning.objectives.tabletop.objective import Tabletop
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import EnvSpec, ObjectSpec
from recorders.grid_rules import OBJECTS
from recorders.grid_things import FACTS, draw


def pictures(*cells: list[tuple[int, int] | None]) -> torch.Tensor:
    """Grid World frames of agent and objects on these cells; None for one that is gone."""
    places = np.array([[cell or (0, 0) for cell in one] for one in cells])
    there = np.array([[cell is not None for cell in one] for one in cells])
    return torch.from_numpy(draw(places, there)[0])


HOME: list[tuple[int, int] | None] = [(0, 0), (1, 1), (3, 1), (1, 3), (3, 3)]
FIRST = torch.zeros(1, dtype=torch.long)


def test_the_papers_cost_is_the_sum_of_squared_distances_of_object_centres() -> None:
    moved = [(4, 4), (2, 1), (3, 1), (1, 4), (3, 3)]
    cost = CentresEvaluator(FACTS, pictures(HOME), 64.0)
    centre = PositionFinder(FACTS).find(pictures(HOME, moved)).centre[:, :OBJECTS]
    by_hand = float((centre[0] - centre[1]).square().sum())
    assert cost.of_frames(pictures(moved), FIRST).item() == pytest.approx(by_hand)
    assert by_hand == pytest.approx(25.6**2 + 25.6**2, rel=0.03)
    assert cost.of_frames(pictures(HOME), FIRST).item() == 0
    assert cost.of_frames(pictures([(4, 0), *HOME[1:]]), FIRST).item() == 0  # the agent does not count


def test_a_missing_object_costs_a_fixed_distance_and_one_that_the_goal_lacks_nothing() -> None:
    gone: list[tuple[int, int] | None] = [HOME[0], None, *HOME[2:]]
    assert CentresEvaluator(FACTS, pictures(HOME), 64.0).of_frames(pictures(gone), FIRST).item() == 64**2
    assert CentresEvaluator(FACTS, pictures(HOME), 7.0).of_frames(pictures(gone), FIRST).item() == 49
    assert CentresEvaluator(FACTS, pictures(gone), 64.0).of_frames(pictures(HOME), FIRST).item() == 0


def test_each_frame_is_compared_with_the_goal_of_its_task() -> None:
    other = [(0, 0), (1, 2), (3, 1), (1, 3), (3, 3)]
    cost = CentresEvaluator(FACTS, pictures(HOME, other), 64.0)
    found = cost.of_frames(pictures(HOME, HOME, other, other), torch.tensor([0, 1, 0, 1]))
    assert (found == 0).tolist() == [True, False, False, True]


def cost_of(evaluator: Evaluator, model: Any, state: Any, task: torch.Tensor) -> torch.Tensor:
    """What a model's states cost."""
    dynamics = ModelDynamics(model, bf16=False)
    with dynamics.computing():
        price, carried = evaluator.step(dynamics, state, task, task, evaluator.begin(dynamics))
    assert carried == ()
    assert torch.equal(price.total, price.distance)
    assert not price.risk.any()
    assert not price.bonus.any()
    return price.total


def test_pixels_and_features_can_stand_in() -> None:
    model, generator = PerfectGridModel(), torch.Generator().manual_seed(0)
    goals = torch.randint(0, 256, (2, 128, 128, 3), generator=generator, dtype=torch.uint8)
    image = torch.rand(3, 3, 128, 128, generator=generator) * 2 - 1
    task = torch.tensor([0, 1, 1])
    wanted = goals.float().mul(2 / 255).sub(1).permute(0, 3, 1, 2)[task]
    by_hand = (image - wanted).square().mean((1, 2, 3))
    for objective in (Pixel(), Feature()):
        evaluator = objective.reset(FACTS, goals.numpy(), goals.numpy())
        torch.testing.assert_close(cost_of(evaluator, model, (image, image), task), by_hand)


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
    evaluator = Feature().reset(FACTS, goals.numpy(), goals.numpy())
    torch.testing.assert_close(cost_of(evaluator, model, state, FIRST), wanted)


def test_objectives_are_made_by_name_and_every_field_can_be_set() -> None:
    assert make_objective("centres", ["lost_distance=1"]) == Centres(lost_distance=1.0)
    assert make_objective("tabletop", ["revisit_penalty=0.1"]) == Tabletop(revisit_penalty=0.1)
    assert make_objective("position") == make_objective("centres")
    assert make_objective("followed") == make_objective("tabletop")
    with pytest.raises(UnknownName, match="no objective named 'pixels'; did you mean 'pixel'"):
        make_objective("pixels")
    with pytest.raises(InvalidSetting, match=r"around_std is 0\.0; it must be above zero"):
        make_objective("tabletop", ["around_std=0"])
    with pytest.raises(InvalidSetting, match=r"lost_distance is -1\.0; it cannot be below zero"):
        make_objective("tracked", ["lost_distance=-1"])
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InvalidSetting, match=f"lost_distance is {wrong}; it cannot be below zero"):
            Centres(lost_distance=wrong)


@pytest.mark.parametrize("name", ["centres", "tracked", "tracked-risk", "tabletop"])
def test_what_needs_objects_says_so(name: str) -> None:
    nothing = EnvSpec(
        id="empty", actions=Discrete(("go",)), agent=ObjectSpec(name="a", shape="dot", color=(0, 0, 0)), objects=()
    )
    goals = pictures(HOME).numpy()
    with pytest.raises(
        InvalidSetting, match="'empty' has no coloured objects to find; plan with another '--objective'"
    ):
        make_objective(name).reset(nothing, goals, goals)


def test_steps_to_go_prefer_what_looks_fewer_steps_from_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The distance of tracked objects, less the bonus for each step that the learned distance does not see left."""

    class Corner(TemporalDistance):
        def embed(self, frames: torch.Tensor) -> torch.Tensor:  # where the agent stands, from left to right
            agent = (frames[:, 1] > 0.9) & (frames[:, 0] < -0.9)
            return (agent * torch.arange(frames.shape[-1])).flatten(1).amax(1, keepdim=True).float() / 128

    network = Corner(TemporalDistanceConfig(reach=20))
    monkeypatch.setattr("dmotion_bench.planning.objectives.steps_to_go.load", lambda name: network)
    goal = pictures([(4, 0), *HOME[1:]])
    near, far = pictures([(3, 0), *HOME[1:]]), pictures(HOME)
    objective = make_objective("steps-to-go", [f"value={'a' * 64}", "step_bonus=3"])
    evaluator = objective.reset(FACTS, far.numpy(), goal.numpy())
    dynamics = ModelDynamics(PerfectGridModel())
    evaluator.begin(dynamics)

    def cost(frames: torch.Tensor) -> StepCost:
        monkeypatch.setattr(dynamics, "frames", lambda state: to_model(frames))
        monkeypatch.setattr(dynamics, "pixels", lambda state: to_pixels(to_model(frames)))
        return evaluator.step(dynamics, (), FIRST, FIRST, ())[0]

    assert cost(goal).bonus.item() == pytest.approx(3 * 20, abs=1e-3)  # no step left
    assert cost(near).bonus > cost(far).bonus > 0
    assert cost(near).distance.item() == cost(far).distance.item() == 0  # the agent is no object
    for frames in (goal, near, far):
        assert cost(frames).total.item() == pytest.approx((cost(frames).distance - cost(frames).bonus).item())


def test_tasks_that_begin_after_a_plan_on_another_device_embed_their_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    network = TemporalDistance(TemporalDistanceConfig(width=2))
    monkeypatch.setattr("dmotion_bench.planning.objectives.steps_to_go.load", lambda name: network)
    objective, goals = make_objective("steps-to-go", [f"value={'d' * 64}"]), pictures(HOME).numpy()
    elsewhere = ModelDynamics(PerfectGridModel(), device=torch.device("meta"), bf16=False)
    objective.reset(FACTS, goals, goals).begin(elsewhere)
    after = objective.reset(FACTS, goals, goals)
    after.begin(ModelDynamics(PerfectGridModel(), bf16=False))
    saved = after.steps_saved(to_model(pictures(HOME)), FIRST)
    assert saved.device.type == "cpu"
    assert saved.item() == pytest.approx(network.config.reach, abs=0.01)


def test_steps_to_go_need_a_learned_distance() -> None:
    with pytest.raises(InvalidSetting, match="names no learned distance; train one with"):
        make_objective("steps-to-go").reset(FACTS, pictures(HOME).numpy(), pictures(HOME).numpy())
