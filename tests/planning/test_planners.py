"""Planners against the exhaustive search, and what they promise: repeatable, the same alone and in company."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from planning.worlds import FarWalks, PerfectGridModel, SmoothWalks, Walks, moment

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.planning.costs import PositionCost
from dmotion_bench.planning.cross_entropy import CrossEntropyPlanner, draw
from dmotion_bench.planning.exhaustive import ExhaustivePlanner, all_sequences
from dmotion_bench.planning.futures import ModelFutures
from dmotion_bench.planning.planner import Moment, Plan, Planner, make_planner, planner_names
from dmotion_bench.planning.tree import FutureTree
from recorders.grid_world import FACTS, GridWorld


def test_exhaustive_finds_the_best_of_all_sequences() -> None:
    plan = ExhaustivePlanner(horizon=4).plan(Walks((0, 1, 2)), moment(3))
    costs = FutureTree(Walks((0, 1, 2)), 4).costs(np.broadcast_to(all_sequences(4, 4), (3, 256, 4))).min(2)
    np.testing.assert_array_equal(plan.costs[:, 0], costs.min(1))
    np.testing.assert_array_equal(plan.candidates[:, 0], all_sequences(4, 4)[costs.argmin(1)])
    assert plan.frames == 3 * (4 + 16 + 64 + 256)


def test_cem_with_enough_samples_finds_the_optimum() -> None:
    tasks = tuple(range(6))
    best = ExhaustivePlanner().plan(SmoothWalks(tasks), moment(6))
    plan = CrossEntropyPlanner(samples=400, elites=40).plan(SmoothWalks(tasks), moment(6))
    np.testing.assert_array_equal(plan.costs[:, 0], best.costs[:, 0])


def test_cem_approaches_the_optimum_with_more_samples() -> None:
    tasks = tuple(range(20))
    best = ExhaustivePlanner().plan(Walks(tasks), moment(20)).costs[:, 0]
    excess = [
        (CrossEntropyPlanner(samples=n, elites=n // 5).plan(Walks(tasks), moment(20)).costs[:, 0] - best).mean()
        for n in (10, 50, 800)
    ]
    assert excess[0] > excess[1] > excess[2] >= 0
    assert excess[2] < 0.01


def test_fitting_to_the_elites_beats_as_many_uniform_draws() -> None:
    tasks = tuple(range(20))
    fitted = CrossEntropyPlanner(horizon=8).plan(FarWalks(tasks), moment(20)).costs[:, 0]
    uniform = CrossEntropyPlanner(horizon=8, samples=200, iterations=1).plan(FarWalks(tasks), moment(20)).costs[:, 0]
    assert fitted.mean() < 0.5 * uniform.mean()


def test_the_papers_setting_is_the_default_and_imagines_few_of_its_thousand_frames() -> None:
    planner = make_planner("cem")
    assert planner == CrossEntropyPlanner(samples=50, horizon=5, iterations=4, elites=10)
    plan = planner.plan(SmoothWalks((1,)), moment(1))
    assert plan.frames < 450  # of 50 * 5 * 4
    assert (np.diff(plan.progress) <= 0).all()
    assert plan.memory is None


PLANNERS = [
    *planner_names(),
    "all variations",
]


def planner_of(name: str) -> Planner:
    if name == "all variations":
        return CrossEntropyPlanner(samples=20, horizon=6, elites=5, stickiness=0.6, kept=4, haste=0.01)
    return make_planner(name)


def same(plan: Plan, other: Plan) -> None:
    for field in ("action", "candidates", "costs", "progress"):
        np.testing.assert_array_equal(getattr(plan, field), getattr(other, field))


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("world", [Walks, SmoothWalks])
def test_a_plan_is_a_function_of_its_random_numbers(name: str, world: Callable[..., Walks]) -> None:
    same(*(planner_of(name).plan(world((4, 7)), moment(2)) for _ in range(2)))


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("world", [Walks, SmoothWalks])
def test_company_changes_nothing(name: str, world: Callable[..., Walks]) -> None:
    tasks = (4, 7, 2, 9)
    blocked = np.zeros((4, 4), np.bool_)
    blocked[1, 2] = blocked[2, [0, 3]] = True
    planner = planner_of(name)
    together = first = planner.plan(world(tasks), moment(4, blocked=blocked))
    if first.memory is not None:  # the second step, too
        together = planner.plan(
            world(tasks), Moment(generators=moment(4, seed=1).generators, blocked=blocked, memory=first.memory)
        )
    for place, task in enumerate(tasks):
        memory = None if first.memory is None else first.memory[place : place + 1]
        seed = 0 if first.memory is None else 1
        alone = planner.plan(
            world((task,)),
            Moment(
                generators=(moment(4, seed=seed).generators[place],),
                blocked=blocked[place : place + 1],
                memory=memory,
            ),
        )
        np.testing.assert_array_equal(alone.action, together.action[place : place + 1])
        np.testing.assert_array_equal(alone.candidates[0], together.candidates[place])
        np.testing.assert_array_equal(alone.costs[0], together.costs[place])


@pytest.mark.parametrize("name", PLANNERS)
def test_blocked_actions_are_not_taken(name: str) -> None:
    for action in range(4):
        blocked = np.zeros((3, 4), np.bool_)
        blocked[:, action] = True
        plan = planner_of(name).plan(Walks((0, 1, 2)), moment(3, blocked=blocked))
        assert (plan.action != action).all()
    free = planner_of(name).plan(Walks((0, 1, 2)), moment(3))
    same(free, planner_of(name).plan(Walks((0, 1, 2)), moment(3, blocked=np.ones((3, 4), np.bool_))))


def test_what_was_best_is_tried_again_one_step_later() -> None:
    planner = CrossEntropyPlanner(samples=6, elites=3, iterations=1, kept=3)
    memory = np.array([[[0, 3, 3, 3, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 2]]])
    futures = SmoothWalks((3,))
    planner.plan(futures, Moment(generators=moment(1).generators, blocked=np.zeros((1, 4), np.bool_), memory=memory))
    tried = {history for _, history in futures.expanded}
    for shifted in ([3, 3, 3, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 2, 2]):
        history = 0
        for action in shifted:
            history = history * 5 + action + 1
        assert history in tried


def test_sequences_are_drawn_with_the_chances_given() -> None:
    chance = np.array([[0.5, 0.5, 0, 0], [0, 0, 0.2, 0.8], [0.25] * 4])
    drawn = draw(np.random.default_rng(0), chance, np.ones(4, np.bool_), 20_000)
    shares = (drawn[..., None] == np.arange(4)).mean(0)
    np.testing.assert_allclose(shares, chance, atol=0.02)
    first = draw(np.random.default_rng(0), chance, np.array([False, True, True, True]), 1000)
    assert (first[:, 0] == 1).all()
    only_others = draw(np.random.default_rng(0), chance, np.array([False, False, True, False]), 1000)
    assert (only_others[:, 0] == 2).all()


def test_sticky_sequences_repeat_themselves() -> None:
    chance, every = np.full((6, 4), 0.25), np.ones(4, np.bool_)
    repeated = {
        stickiness: (np.diff(draw(np.random.default_rng(0), chance, every, 5000, stickiness)) == 0).mean()
        for stickiness in (0.0, 0.6)
    }
    assert repeated[0.0] == pytest.approx(0.25, abs=0.02)
    assert repeated[0.6] == pytest.approx(0.6 + 0.4 * 0.25, abs=0.02)


def test_a_push_is_planned_through_images() -> None:
    env, model = GridWorld(), PerfectGridModel()
    start, _ = env.reset(seed=5)
    goal = start
    for action in (3, 3, 1, 1, 2):
        if env.legal_actions()[action]:
            goal, *_ = env.step(action)
    images, goals = torch.from_numpy(start)[None], torch.from_numpy(goal)[None]
    futures = ModelFutures(model, PositionCost(FACTS, goals), images, images, bf16=False)
    plan = ExhaustivePlanner().plan(futures, moment(1))
    assert plan.costs[0, 0] == 0
    env.reset(seed=5)
    reached = [env.step(action)[0] for action in plan.candidates[0, 0].tolist()]
    cost = PositionCost(FACTS, goals)
    assert min(float(cost.of_frames(torch.from_numpy(one)[None], torch.tensor([0]))) for one in reached) == 0


@pytest.mark.parametrize(
    "wrong", [{"samples": 0}, {"elites": 60}, {"horizon": 0}, {"iterations": 0}, {"kept": 51}, {"stickiness": 1.0}]
)
def test_settings_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidSetting, match=next(iter(wrong))):
        CrossEntropyPlanner(**wrong)  # type: ignore[arg-type]


def test_an_unknown_planner_gets_the_close_match() -> None:
    with pytest.raises(UnknownName, match="did you mean 'exhaustive'"):
        make_planner("exhaustiv")
    with pytest.raises(InvalidSetting, match="1 to 8 steps"):
        ExhaustivePlanner(horizon=12)
