"""Solvers against the exhaustive search, and what they promise: repeatable, the same alone and in company."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from planning.worlds import FarWalks, PerfectGridModel, SmoothWalks, Walks, context, observed, unseen

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.objectives.centres import Centres, CentresEvaluator
from dmotion_bench.planning.solvers.base import Plan, Solver
from dmotion_bench.planning.solvers.cem import CostAt, CrossEntropy
from dmotion_bench.planning.solvers.exhaustive import Exhaustive, all_sequences
from dmotion_bench.planning.solvers.icem import ImprovedCrossEntropy
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.planning.solvers.proposals import draw
from recorders.grid_things import FACTS
from recorders.grid_world import GridWorld


def test_exhaustive_finds_the_best_of_all_sequences() -> None:
    plan = Walks((0, 1, 2)).plan(Exhaustive(horizon=4), context(3))
    costs = (
        PrefixTree(walks := Walks((0, 1, 2)), walks.evaluator, unseen(3), 4)
        .costs(np.broadcast_to(all_sequences(4, 4), (3, 256, 4)))
        .min(2)
    )
    np.testing.assert_array_equal(plan.costs[:, 0], costs.min(1))
    np.testing.assert_array_equal(plan.candidates[:, 0], all_sequences(4, 4)[costs.argmin(1)])
    assert plan.frames == 3 * (4 + 16 + 64 + 256)


@pytest.mark.slow
def test_cem_with_enough_samples_finds_the_optimum() -> None:
    tasks = tuple(range(6))
    best = SmoothWalks(tasks).plan(Exhaustive(), context(6))
    plan = SmoothWalks(tasks).plan(CrossEntropy(samples=400, elites=40), context(6))
    np.testing.assert_array_equal(plan.costs[:, 0], best.costs[:, 0])


@pytest.mark.parametrize("cost_at", ["last", "sum"])
def test_a_sequence_can_be_judged_by_its_end_or_by_all_its_steps(cost_at: CostAt) -> None:
    tasks = (0, 1, 2)
    tree = PrefixTree(walks := SmoothWalks(tasks), walks.evaluator, unseen(3), 5)
    costs = tree.costs(np.broadcast_to(all_sequences(4, 5), (3, 1024, 5)))
    best = (costs[..., -1] if cost_at == "last" else costs.sum(2)).min(1)

    plan = SmoothWalks(tasks).plan(CrossEntropy(samples=400, elites=40, cost_at=cost_at), context(3))

    np.testing.assert_array_equal(plan.costs[:, 0], best)
    with pytest.raises(InvalidSetting, match="cost_at is 'first'; it can be best, last, sum"):
        make_solver("cem", ["cost_at=first"])


def test_held_actions_are_the_best_of_those_that_are_held() -> None:
    tasks = (0, 1, 2)
    held = np.unique(all_sequences(4, 3).repeat(2, axis=1)[:, :5], axis=0)  # 64: choices at steps 0, 2 and 4
    tree = PrefixTree(walks := SmoothWalks(tasks), walks.evaluator, unseen(3), 5)
    best = tree.costs(np.broadcast_to(held, (3, *held.shape))).min(2).min(1)

    plan = SmoothWalks(tasks).plan(CrossEntropy(samples=300, elites=30, hold=2), context(3))

    np.testing.assert_array_equal(plan.costs[:, 0], best)
    np.testing.assert_array_equal(plan.candidates[:, :, 0], plan.candidates[:, :, 1])
    np.testing.assert_array_equal(plan.candidates[:, :, 2], plan.candidates[:, :, 3])


@pytest.mark.slow
def test_cem_approaches_the_optimum_with_more_samples() -> None:
    tasks = tuple(range(20))
    best = Walks(tasks).plan(Exhaustive(), context(20)).costs[:, 0]
    excess = [
        (Walks(tasks).plan(CrossEntropy(samples=n, elites=n // 5), context(20)).costs[:, 0] - best).mean()
        for n in (10, 50, 800)
    ]
    assert excess[0] > excess[1] > excess[2] >= 0
    assert excess[2] < 0.01


@pytest.mark.slow
def test_fitting_to_the_elites_beats_as_many_uniform_draws() -> None:
    tasks = tuple(range(20))
    fitted = FarWalks(tasks).plan(CrossEntropy(horizon=8), context(20)).costs[:, 0]
    uniform = FarWalks(tasks).plan(CrossEntropy(horizon=8, samples=200, iterations=1), context(20)).costs[:, 0]
    assert fitted.mean() < 0.5 * uniform.mean()


def test_the_papers_setting_is_the_default_and_imagines_few_of_its_thousand_frames() -> None:
    solver = make_solver("cem")
    assert solver == CrossEntropy(samples=50, horizon=5, iterations=4, elites=10)
    plan = SmoothWalks((1,)).plan(solver, context(1))
    assert plan.frames < 450  # of 50 * 5 * 4
    assert (np.diff(plan.progress) <= 0).all()
    assert plan.memory is None


SOLVERS = ["cem", "exhaustive", "icem", "all variations"]


def solver_of(name: str) -> Solver:
    if name == "all variations":
        return CrossEntropy(samples=20, horizon=6, elites=5, action_repeat_prob=0.6, kept_elites=4, step_discount=0.01)
    return make_solver(name)


def same(plan: Plan, other: Plan) -> None:
    for field in ("action", "candidates", "costs", "progress"):
        np.testing.assert_array_equal(getattr(plan, field), getattr(other, field))


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("world", [Walks, SmoothWalks])
def test_a_plan_is_a_function_of_its_random_numbers(name: str, world: Callable[..., Walks]) -> None:
    same(*(world((4, 7)).plan(solver_of(name), context(2)) for _ in range(2)))


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("world", [Walks, SmoothWalks])
def test_company_changes_nothing(name: str, world: Callable[..., Walks]) -> None:
    tasks = (4, 7, 2, 9)
    blocked = np.zeros((4, 4), np.bool_)
    blocked[1, 2] = blocked[2, [0, 3]] = True
    solver = solver_of(name)
    together = first = world(tasks).plan(solver, context(4, blocked=blocked))
    if first.memory is not None:  # the second step, too
        together = world(tasks).plan(solver, context(4, seed=1, blocked=blocked, memory=first.memory))
    for place, task in enumerate(tasks):
        memory = None if first.memory is None else first.memory[place : place + 1]
        seed = 0 if first.memory is None else 1
        both = context(4, seed=seed, blocked=blocked)
        own = replace(
            both,
            observation=unseen(1),
            generators=both.generators[place : place + 1],
            blocked=blocked[place : place + 1],
            memory=memory,
        )
        alone = world((task,)).plan(solver, own)
        np.testing.assert_array_equal(alone.action, together.action[place : place + 1])
        np.testing.assert_array_equal(alone.candidates[0], together.candidates[place])
        np.testing.assert_array_equal(alone.costs[0], together.costs[place])


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_blocked_actions_are_not_taken(name: str) -> None:
    for action in range(4):
        blocked = np.zeros((3, 4), np.bool_)
        blocked[:, action] = True
        plan = Walks((0, 1, 2)).plan(solver_of(name), context(3, blocked=blocked))
        assert (plan.action != action).all()
    free = Walks((0, 1, 2)).plan(solver_of(name), context(3))
    same(free, Walks((0, 1, 2)).plan(solver_of(name), context(3, blocked=np.ones((3, 4), np.bool_))))


@pytest.mark.parametrize("cost", [-2.0, 0.0, 3.0])
def test_of_equal_costs_the_sooner_one_is_better_whatever_their_sign(cost: float) -> None:
    solver = CrossEntropy(horizon=4, step_discount=0.5)
    late, soon = np.full(4, 9.0), np.full(4, 9.0)
    late[3] = soon[1] = cost

    after, before = solver._of_sequences(np.stack([late, soon])[None])[0]

    assert (before < after) if cost else (before == after)
    assert after == (cost * 2.5 if cost >= 0 else cost / 2.5)


def test_what_was_best_is_tried_again_one_step_later() -> None:
    solver = CrossEntropy(samples=6, elites=3, iterations=1, kept_elites=3)
    memory = np.array([[[0, 3, 3, 3, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 2]]])
    walks = SmoothWalks((3,))
    walks.plan(solver, context(1, memory=memory))
    tried = {history for _, history in walks.expanded}
    for shifted in ([3, 3, 3, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 2, 2]):
        assert walks_to(shifted) in tried


def walks_to(actions: Sequence[int]) -> int:
    """The history of a walk that takes these actions."""
    history = 0
    for action in actions:
        history = history * 5 + int(action) + 1
    return history


@pytest.mark.parametrize("kept_elites", [0, 3])
def test_a_plan_is_carried_on_until_the_next_search(kept_elites: int) -> None:
    tasks = (3, 5)
    walks = SmoothWalks(tasks)
    solver = CrossEntropy(samples=6, elites=3, iterations=2, kept_elites=kept_elites, replan_every=3)
    first = walks.plan(solver, context(2))
    known, plan = len(walks.expanded), first
    for step in (1, 2):
        plan = walks.plan(solver, context(2, memory=plan.memory, observation=replace(unseen(2), step=step)))
        np.testing.assert_array_equal(plan.action, first.candidates[:, 0, step])
        assert plan.frames == 0
        assert len(walks.expanded) == known
    again = walks.plan(solver, context(2, memory=plan.memory, observation=replace(unseen(2), step=3)))
    assert again.frames
    if kept_elites:  # what was best is tried again, three steps later
        best = first.candidates[0, 0]
        assert walks_to([*best[3:], *[best[-1]] * 3]) in {history for _, history in walks.expanded[known:]}


def test_sequences_are_drawn_with_the_chances_given() -> None:
    chance = np.array([[0.5, 0.5, 0, 0], [0, 0, 0.2, 0.8], [0.25] * 4])
    drawn = draw(np.random.default_rng(0), chance, np.ones(4, np.bool_), 20_000)
    shares = (drawn[..., None] == np.arange(4)).mean(0)
    np.testing.assert_allclose(shares, chance, atol=0.02)
    first = draw(np.random.default_rng(0), chance, np.array([False, True, True, True]), 1000)
    assert (first[:, 0] == 1).all()
    only_others = draw(np.random.default_rng(0), chance, np.array([False, False, True, False]), 1000)
    assert (only_others[:, 0] == 2).all()


def test_sequences_that_repeat_actions_repeat_themselves() -> None:
    chance, every = np.full((6, 4), 0.25), np.ones(4, np.bool_)
    repeated = {
        repeat: (np.diff(draw(np.random.default_rng(0), chance, every, 5000, repeat)) == 0).mean()
        for repeat in (0.0, 0.6)
    }
    assert repeated[0.0] == pytest.approx(0.25, abs=0.02)
    assert repeated[0.6] == pytest.approx(0.6 + 0.4 * 0.25, abs=0.02)


@pytest.mark.slow
def test_a_push_is_planned_through_images() -> None:
    env, model = GridWorld(), PerfectGridModel()
    start, _ = env.reset(seed=5)
    goal = start
    for action in (3, 3, 1, 1, 2):
        if env.legal_actions()[action]:
            goal, *_ = env.step(action)
    dynamics, seen = ModelDynamics(model, bf16=False), observed(start[None], goals=goal[None])
    evaluator = Centres().reset(FACTS, start[None], goal[None])
    plan = Exhaustive().plan(dynamics, evaluator, context(1, observation=seen))
    assert plan.costs[0, 0] == 0
    assert plan.parts["distance"][0].tolist() == pytest.approx(plan.costs[0].tolist())
    env.reset(seed=5)
    reached = [env.step(action)[0] for action in plan.candidates[0, 0].tolist()]
    cost = CentresEvaluator(FACTS, torch.from_numpy(goal)[None], 64.0)
    assert min(float(cost.of_frames(torch.from_numpy(one)[None], torch.tensor([0]))) for one in reached) == 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"samples": 0},
        {"elites": 60},
        {"horizon": 0},
        {"iterations": 0},
        {"kept_elites": 51},
        {"action_repeat_prob": 1.0},
        {"replan_every": 0},
        {"replan_every": 6},
    ],
)
def test_settings_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidSetting, match=next(iter(wrong))):
        CrossEntropy(**wrong)  # type: ignore[arg-type]


def test_an_unknown_solver_gets_the_close_match() -> None:
    with pytest.raises(UnknownName, match=r"no planner named .*did you mean 'exhaustive'"):
        make_solver("exhaustiv")
    with pytest.raises(InvalidSetting, match="1 to 8 steps"):
        Exhaustive(horizon=12)


def test_all_sequences_are_not_looked_at_where_there_are_millions() -> None:
    class Many(Walks):
        actions = Discrete.numbered(12)

    many = Many((0,))
    with pytest.raises(InvalidSetting, match="6 steps of 12 actions make 2,985,984 sequences"):
        many.plan(Exhaustive(horizon=6), context(1))


def test_every_field_can_be_set_by_name() -> None:
    assert make_solver("icem", ["horizon=10", "kept_elites=2"]) == ImprovedCrossEntropy(horizon=10, kept_elites=2)
    with pytest.raises(InvalidSetting, match="no setting named 'horizn'; did you mean 'horizon'"):
        make_solver("icem", ["horizn=10"])
    with pytest.raises(InvalidSetting, match="horizon is 'x'; it must be a whole number"):
        make_solver("cem", ["horizon=x"])
    with pytest.raises(InvalidSetting, match="--planner-set 'horizon' has no value; write --planner-set horizon=VALUE"):
        make_solver("cem", ["horizon"])
    assert make_solver("icem") == ImprovedCrossEntropy(
        samples=50, horizon=5, iterations=4, elites=10, action_repeat_prob=0.6, kept_elites=5, step_discount=0.0
    )
