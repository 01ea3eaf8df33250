"""Continuous actions: every solver finds its way, the same alone and in company; the loop goes on where it stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from planning.sliding import ACTIONS, FACTS, SIZE, STEP, Blob, Sliding, problem
from planning.worlds import Walks, context, observed, unseen

from dmotion_bench.errors import InvalidSetting, ModelContractBroken, PlannerContractBroken
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.planning.agents import IdleAgent, ModelAgent, RandomAgent, make_reference
from dmotion_bench.planning.choices import make_objective, make_solver
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.journal import Extent, Journal
from dmotion_bench.planning.mpc import ControlResult, ControlSettings, control
from dmotion_bench.planning.objectives.base import StepCost
from dmotion_bench.planning.objectives.centres import Centres
from dmotion_bench.planning.objectives.feature import Feature, FeatureEvaluator
from dmotion_bench.planning.objectives.pixel import Pixel
from dmotion_bench.planning.solvers.base import PlanContext
from dmotion_bench.planning.solvers.mppi import PathIntegral
from dmotion_bench.planning.solvers.proposals import Gaussian, coloured
from dmotion_bench.planning.solvers.rollouts import Rollouts

SOLVERS = ("cem", "icem", "mppi", "random-shooting", "gradient")
GOOD = {"cem": 0.05, "icem": 0.05, "mppi": 0.1, "random-shooting": 0.2, "gradient": 0.05}
"""How far from the goal the best plan may end, where it starts 0.45 away [m]."""


def blob(*places: tuple[float, float]) -> np.ndarray:
    state = (torch.tensor(places),)
    return to_pixels(Blob().frame(state)).numpy()


def seen(starts: list[tuple[float, float]], goals: list[tuple[float, float]]) -> PlanContext:
    empty = np.zeros((len(starts), 0), np.bool_)
    return context(len(starts), blocked=empty, observation=observed(blob(*starts), goals=blob(*goals)))


def alone(both: PlanContext, place: int, memory: Any = None) -> PlanContext:
    own = slice(place, place + 1)
    observation = replace(
        both.observation,
        **{name: getattr(both.observation, name)[own] for name in ("previous", "current", "goals")},
    )
    return replace(
        both, observation=observation, generators=both.generators[own], blocked=both.blocked[own], memory=memory
    )


TWO = seen([(0.2, 0.2), (0.7, 0.3)], [(0.5, 0.53), (0.3, 0.5)])


def plan_of(name: str, given: PlanContext, objective: Any = None, settings: list[str] | None = None) -> Any:
    fresh = replace(
        given, generators=tuple(np.random.default_rng([3, int(one.integers(9))]) for one in given.generators)
    )
    dynamics = ModelDynamics(Blob(), bf16=False)
    evaluator = (objective or Feature()).reset(FACTS, given.observation.current, given.observation.goals)
    return make_solver(name, settings or []).plan(dynamics, evaluator, fresh)


def generators(*names: int) -> tuple[np.random.Generator, ...]:
    return tuple(np.random.default_rng([7, name]) for name in names)


@pytest.mark.parametrize("name", SOLVERS)
def test_the_best_plan_leads_to_the_goal(name: str) -> None:
    plan = plan_of(name, replace(TWO, generators=generators(0, 1)))
    ends = [np.array([0.2, 0.2]), np.array([0.7, 0.3])]
    for place, goal in enumerate([(0.5, 0.53), (0.3, 0.5)]):
        way = ends[place] + STEP * plan.candidates[place, 0].cumsum(axis=0)
        assert np.linalg.norm(way - goal, axis=1).min() < GOOD[name]
    assert np.abs(plan.candidates).max() <= 1
    assert plan.action.shape == (2, 2)
    assert (np.diff(plan.progress) <= 0).all()
    np.testing.assert_allclose(plan.parts["distance"], plan.costs, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_company_changes_nothing(name: str) -> None:
    dynamics = ModelDynamics(Blob(), bf16=False, at_once=7)

    def planned(given: PlanContext) -> Any:
        evaluator = Feature().reset(FACTS, given.observation.current, given.observation.goals)
        return make_solver(name).plan(dynamics, evaluator, given)

    first = planned(replace(TWO, generators=generators(0, 1)))
    together = planned(replace(TWO, generators=generators(2, 3), memory=first.memory))
    for place in range(2):
        memory = None if first.memory is None else first.memory[place : place + 1]
        own = alone(replace(TWO, generators=generators(2, 3)), place, memory)
        by_itself = planned(own)
        np.testing.assert_allclose(by_itself.action[0], together.action[place], atol=1e-5)
        np.testing.assert_allclose(by_itself.costs[0], together.costs[place], atol=1e-6)


@pytest.mark.parametrize("name", ["icem", "mppi", "gradient"])
def test_a_plan_is_gone_on_with(name: str) -> None:
    """With what was planned before it begins where the last plan ended, shifted by one."""
    few = {"icem": ["iterations=1", "samples=6", "elites=3"], "mppi": ["iterations=1"], "gradient": ["iterations=1"]}
    solver, dynamics = make_solver(name, few[name]), ModelDynamics(Blob(), bf16=False)
    evaluator = Feature().reset(FACTS, TWO.observation.current, TWO.observation.goals)
    best = plan_of("icem", replace(TWO, generators=generators(0, 1)))
    cold = solver.plan(dynamics, evaluator, replace(TWO, generators=generators(4, 5)))
    memory = best.candidates[:, :1]
    memory = np.concatenate([memory[:, :, :1], memory], axis=2)[:, :, :5]  # as if planned one step before
    warm = solver.plan(dynamics, evaluator, replace(TWO, generators=generators(4, 5), memory=memory))
    assert (warm.costs[:, 0] < cold.costs[:, 0]).all()


class Forbidding(FeatureEvaluator):
    """Costs of features; infinite to the right of the start in task 0, and everywhere in task 1."""

    def step(self, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
        cost, carried = super().step(dynamics, state, task, action, cost_state)
        forbidden = (task == 1) | (state[0][:, 0] > 0.2)
        return StepCost.of(cost.total.masked_fill(forbidden, torch.inf)), carried


def test_path_integrals_leave_out_sequences_of_infinite_cost() -> None:
    """What is forbidden moves no mean; a task in which everything is keeps the mean that it had."""
    memory = np.full((2, 1, 5, 2), 0.25)
    given = replace(TWO, generators=generators(0, 1), memory=memory)
    evaluator = Forbidding(TWO.observation.goals)
    plan = make_solver("mppi").plan(ModelDynamics(Blob(), bf16=False), evaluator, given)
    assert np.isfinite(plan.costs[0]).all()
    assert np.isfinite(plan.action).all()
    np.testing.assert_array_equal(plan.action[1], [0.25, 0.25])
    np.testing.assert_array_equal(plan.costs[1], np.inf)

    costs = np.array([[3.0, np.inf, 1.0, 2.5, np.inf]])
    weights = PathIntegral()._weights(costs)
    np.testing.assert_array_equal(weights[:, [0, 2, 3]], PathIntegral()._weights(costs[:, [0, 2, 3]]))
    np.testing.assert_array_equal(weights[:, [1, 4]], 0)


class Distance(FeatureEvaluator):
    """A root, which has no gradient where it is zero; or NaN; or infinite, with a gradient of NaN."""

    def __init__(self, goals: np.ndarray, kind: str) -> None:
        super().__init__(goals)
        self.kind = kind

    def step(self, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
        cost, carried = super().step(dynamics, state, task, action, cost_state)
        factor = {"no gradient": 0.0, "not a number": torch.nan, "infinite": torch.inf}[self.kind]
        return StepCost.of((cost.total * factor).sqrt() if self.kind != "infinite" else cost.total * factor), carried


@pytest.mark.parametrize(
    ("kind", "said"), [("no gradient", "the gradient of the cost holds NaN"), ("not a number", "not numbers")]
)
def test_what_a_gradient_cannot_follow_is_said(kind: str, said: str) -> None:
    given = replace(TWO, generators=generators(0, 1))
    with pytest.raises(PlannerContractBroken, match=said):
        make_solver("gradient").plan(ModelDynamics(Blob(), bf16=False), Distance(TWO.observation.goals, kind), given)


def test_a_sequence_of_infinite_cost_stays_where_it_is() -> None:
    given = replace(TWO, generators=generators(0, 1))
    evaluator = Distance(TWO.observation.goals, "infinite")
    plan = make_solver("gradient").plan(ModelDynamics(Blob(), bf16=False), evaluator, given)
    assert np.isfinite(plan.candidates).all()


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("steps", [1, 2, 5, 8])
def test_coloured_noise_has_unit_deviation_and_its_colour(exponent: float, steps: int) -> None:
    noise = coloured(np.random.default_rng(0), (20_000, steps), exponent)
    np.testing.assert_allclose(noise.std(axis=0), 1, atol=0.03)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.03)
    if steps == 8:
        power = (np.abs(np.fft.rfft(noise, axis=1)) ** 2).mean(axis=0)
        ratio = power[1] / power[2]
        assert ratio == pytest.approx(2**exponent, rel=0.05)
        frequency = np.array([1, 1, 2, 3, 4]) / 8  # the lowest one stands for the constant, too
        shares = frequency**-exponent * [1, 2, 2, 2, 1]
        wanted = (shares * np.cos(2 * np.pi * np.array([0, 1, 2, 3, 4]) / 8)).sum() / shares.sum()
        following = np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]
        assert following == pytest.approx(wanted, abs=0.03)


def test_a_gaussian_is_fitted_to_its_elites() -> None:
    elite = np.random.default_rng(0).normal(0.2, 0.1, (1, 10, 3, 2))
    wide = Gaussian(mean=np.zeros((1, 3, 2)), std=np.ones((1, 3, 2)), exponent=0.0, momentum=0.25)
    fitted = wide.fitted(elite)
    np.testing.assert_allclose(fitted.mean, 0.75 * elite.mean(axis=1))
    np.testing.assert_allclose(fitted.std, 0.25 + 0.75 * elite.std(axis=1))
    drawn = wide.draw(generators(0), 50, temperature=0)
    assert np.abs(drawn).max() == 1  # clipped
    np.testing.assert_array_equal(drawn[:, -1], wide.mean)


@pytest.mark.slow
def test_gradients_go_through_the_model_and_need_an_objective_that_has_some() -> None:
    pixels = plan_of("gradient", replace(TWO, generators=generators(0, 1)), Pixel())
    assert (pixels.progress[:, -1] < 0.5 * pixels.progress[:, 0]).all()
    with pytest.raises(InvalidSetting, match="needs a gradient of the cost, and this objective has none"):
        plan_of("gradient", replace(TWO, generators=generators(0, 1)), Centres())
    tasks = [problem(0, Sliding())]
    with pytest.raises(InvalidSetting, match="the true simulator has no gradients"):
        solve("oracle", tasks, solver="gradient", steps=1)


@pytest.mark.parametrize("name", ["mppi", "gradient"])
def test_solvers_of_continuous_actions_refuse_discrete_ones(name: str) -> None:
    walks = Walks((0,))
    with pytest.raises(InvalidSetting, match=f"the planner '{name}' needs continuous actions, and these are discrete"):
        walks.plan(make_solver(name), context(1, observation=unseen(1)))


@pytest.mark.parametrize("name", ["exhaustive", "icem-graph"])
def test_solvers_of_discrete_actions_refuse_continuous_ones(name: str) -> None:
    said = r"the planner needs discrete actions, and these are continuous.*or another planner"
    with pytest.raises(InvalidSetting, match=said):
        plan_of(name, TWO)


@pytest.mark.parametrize("shape", [(2, 3, 4, 1), (2, 3, 4, 4), (2, 3, 4), (2, 0, 4, 2), (1, 3, 4, 2)])
def test_sequences_of_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    evaluator = Feature().reset(FACTS, TWO.observation.current, TWO.observation.goals)
    rollouts = Rollouts(ModelDynamics(Blob(), bf16=False), evaluator, TWO.observation)
    said = r"they must be a NumPy array of the shape \(2, sequences, steps, 2\), of floating-point numbers"
    with pytest.raises(PlannerContractBroken, match=said):
        rollouts.stacked_costs(np.zeros(shape))


def test_random_shooting_draws_discrete_actions_too() -> None:
    blocked = np.array([[True, False, False, False]])
    plan = Walks((0,)).plan(make_solver("random-shooting"), context(1, blocked=blocked))
    assert plan.action[0] != 0
    assert plan.candidates.shape == (1, 5, 5)
    assert plan.frames < 200 * 5


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("mppi", "samples=0"),
        ("mppi", "temperature=0"),
        ("mppi", "noise_exponent=-1"),
        ("gradient", "learning_rate=0"),
        ("gradient", "iterations=0"),
        ("random-shooting", "horizon=0"),
        ("cem", "momentum=1"),
        ("cem", "initial_std=0"),
        ("icem", "noise_exponent=-1"),
    ],
)
def test_settings_that_cannot_be(name: str, wrong: str) -> None:
    with pytest.raises(InvalidSetting, match=wrong.partition("=")[0]):
        make_solver(name, [wrong])


def solve(
    who: str, problems: list[Any], *, solver: str = "icem", objective: Any = None, **settings: Any
) -> ControlResult:
    few = ["samples=16", "iterations=3"] + (["elites=4"] if "cem" in solver else [])
    agent = make_reference(who, FACTS, Sliding, make_solver(solver, few), objective)
    return control(agent, problems, Sliding, ControlSettings(**settings))


@pytest.fixture(scope="module")
def problems() -> list[Any]:
    return [problem(number, Sliding()) for number in range(2)]


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["icem", "mppi"])
def test_the_oracle_pushes_the_puck_to_its_goal(problems: list[Any], solver: str) -> None:
    result = solve("oracle", problems, solver=solver, steps=15)
    assert result.actions.shape == (2, 15, 2)
    assert ACTIONS.fault(result.actions.reshape(-1, 2)) is None
    assert result.distance[:, -1].mean() < 0.15


@pytest.mark.slow
def test_objectives_of_images_work_with_continuous_actions(problems: list[Any]) -> None:
    result = solve("oracle", problems[:1], objective=make_objective("tracked"), steps=10)
    assert result.distance[0].min() < 0.4
    assert solve("oracle", problems[:1], objective=make_objective("tabletop"), steps=1).planned == 1


def test_who_does_nothing_and_who_does_anything(problems: list[Any]) -> None:
    idle, random = (solve(who, problems, steps=4) for who in ("idle", "random"))
    assert np.isnan(idle.actions).all()
    np.testing.assert_array_equal(idle.distance, 1)
    assert len({tuple(row) for row in random.actions.reshape(-1, 2).tolist()}) == 8
    assert ACTIONS.fault(random.actions.reshape(-1, 2)) is None
    with pytest.raises(InvalidSetting, match="'sliding' comes with no scripted reference"):
        solve("scripted", problems, steps=1)


class Killed(Exception):
    """The process is gone."""


@pytest.mark.slow
@pytest.mark.parametrize("who", ["idle", "oracle"])
def test_a_killed_run_goes_on_with_the_same_result(
    problems: list[Any], who: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    solver, settings = make_solver("icem", ["samples=8", "elites=3", "iterations=2"]), ControlSettings(steps=5, group=1)
    extent = Extent(actions=ACTIONS, tasks=len(problems), steps=5)

    def run(watch: Any = lambda _: None, journal: Journal | None = None) -> ControlResult:
        agent = make_reference(who, FACTS, Sliding, solver)
        return control(agent, problems, Sliding, settings, journal=journal, watch=watch)

    def die(scene: Any) -> None:
        if scene.context.observation.step == 3:
            raise Killed

    with pytest.raises(Killed):
        run(die, Journal(tmp_path / "journal.json", {}, extent))
    begun, whole = run(journal=Journal(tmp_path / "journal.json", {}, extent)), run()
    assert begun.planned < whole.planned
    for field in ("actions", "distance", "lost"):
        np.testing.assert_array_equal(getattr(begun, field), getattr(whole, field))


def test_a_model_of_other_bounds_is_refused() -> None:
    other = replace(FACTS, actions=replace(ACTIONS, high=(1.0, 1.0)))
    with pytest.raises(ModelContractBroken, match=r"made for the continuous action dx \(-0.1 to 0.1 m\), dy"):
        ModelAgent(Blob(), other, make_solver("icem"), Feature())
    assert IdleAgent(ACTIONS).act(TWO).action.shape == RandomAgent(ACTIONS).act(TWO).action.shape == (2, 2)
    assert blob((0.5, 0.5)).shape == (1, SIZE, SIZE, 3)
