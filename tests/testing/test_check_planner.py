"""What somebody's solver or objective breaks silently is found by ``check_solver`` and ``check_objective``."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from walking_square import record_walks

from dmotion_bench import registry
from dmotion_bench.errors import InvalidSetting, PlannerContractBroken
from dmotion_bench.planning.objectives.base import Memoryless, StepCost
from dmotion_bench.planning.objectives.pixel import Pixel
from dmotion_bench.planning.solvers.base import best_first
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.planning.solvers.rollouts import Rollouts
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.testing import CONTINUOUS, check_objective, check_solver

DISCRETE = ("cem", "exhaustive", "icem", "icem-graph", "icem-recall", "random-shooting")
OF_NUMBERS = ("cem", "gradient", "icem", "icem-recall", "mppi", "random-shooting")
TURNS = itertools.count()
SIGHTED = ("centres", "feature", "pixel", "tabletop", "tracked", "tracked-risk")  # the others learn from video first


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "actions"), [*((one, 4) for one in DISCRETE), *((one, CONTINUOUS) for one in OF_NUMBERS)]
)
def test_our_solvers_keep_the_contract(name: str, actions: Any) -> None:
    check_solver(registry.solver_class(name), actions=actions)


@pytest.mark.slow
@pytest.mark.parametrize("name", SIGHTED)
def test_our_objectives_keep_the_contract(name: str) -> None:
    check_objective(registry.objective_class(name), actions=CONTINUOUS if name == "tracked" else 4)


def test_an_objective_that_learns_first_is_given_video(tmp_path: Path) -> None:
    with pytest.raises(InvalidSetting, match="learns from video first"):
        check_objective(registry.objective_class("tracked-belief"))
    seen = list[Any]()

    @dataclass(frozen=True, kw_only=True)
    class Learner(Pixel):
        def learned(self, video: Any) -> Any:
            seen.append(video)
            return Pixel()

    video = Dataset.open(record_walks(tmp_path / "walk"))
    check_objective(Learner, video=video)
    assert seen == [video]


@dataclass(frozen=True, kw_only=True)
class Dice:
    """The solver of the tutorial."""

    samples: int = 32
    horizon: int = 3

    def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
        tree = PrefixTree(dynamics, evaluator, context.observation, self.horizon)
        sequences = self.drawn(tree.actions, context)
        costs = tree.costs(sequences).min(axis=2)
        blocked = np.take_along_axis(context.blocked, sequences[:, :, 0], axis=1)
        best, price = best_first(sequences, np.where(blocked, np.inf, costs))
        return tree.plan(best, price, [price[:, 0]])

    def drawn(self, actions: int, context: Any) -> Any:
        shape = self.samples, self.horizon
        return np.stack([one.integers(0, actions, shape) for one in context.generators])


def test_the_tutorials_solver_keeps_the_contract() -> None:
    check_solver(Dice)


def test_a_memory_of_other_actions_is_found() -> None:
    class Wide(CrossEntropy):
        def plan(self, *given: Any) -> Any:
            plan = super().plan(*given)
            object.__setattr__(plan, "memory", np.zeros((*plan.candidates.shape[:3], 5)))  # past the check of shapes
            return plan

    with pytest.raises(PlannerContractBroken, match="remembers actions of 5 numbers; there are 2 in each"):
        check_solver(Wide, actions=CONTINUOUS)


def _of_numpy(self: Dice, actions: int, context: Any) -> Any:
    return np.random.randint(0, actions, (len(context.generators), self.samples, self.horizon))  # noqa: NPY002


def _of_torch(self: Dice, actions: int, context: Any) -> Any:
    return torch.randint(0, actions, (len(context.generators), self.samples, self.horizon)).numpy()


def _of_python(self: Dice, actions: int, context: Any) -> Any:
    shape = len(context.generators), self.samples, self.horizon
    return np.array([random.randrange(actions) for _ in range(np.prod(shape))]).reshape(shape)


def _of_a_clock(self: Dice, actions: int, context: Any) -> Any:
    generator = np.random.default_rng(next(TURNS))
    return generator.integers(0, actions, (len(context.generators), self.samples, self.horizon))


def _of_the_first_task(self: Dice, actions: int, context: Any) -> Any:
    shape = len(context.generators), self.samples, self.horizon
    return context.generators[0].integers(0, actions, shape)


@pytest.mark.parametrize(
    ("drawn", "said"),
    [
        (_of_numpy, r"Drawing\.plan planned otherwise when it was given the same context again; random numbers must"),
        (_of_torch, "when it was given the same context again"),
        (_of_python, "when it was given the same context again"),
        (_of_a_clock, "when it was given the same context again"),
        (_of_the_first_task, r"planned task 1 otherwise when it was alone; each task must draw from its own generator"),
    ],
)
def test_random_numbers_come_from_each_tasks_own_generator(drawn: Callable[..., Any], said: str) -> None:
    with pytest.raises(PlannerContractBroken, match=said):
        check_solver(type("Drawing", (Dice,), {"drawn": drawn}))


@dataclass(frozen=True, kw_only=True)
class Writing(Dice):
    """Writes into one of the things that it is given."""

    into: ClassVar[str] = "current"

    def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
        plan = super().plan(dynamics, evaluator, context)
        getattr(context if self.into == "blocked" else context.observation, self.into)[:] = 1
        return plan


@pytest.mark.parametrize("into", ["previous", "current", "goals", "blocked"])
def test_what_a_solver_writes_into_its_context_is_found(into: str) -> None:
    with pytest.raises(PlannerContractBroken, match=rf"wrote into context\.(observation\.)?{into}; take a copy"):
        check_solver(type("Into", (Writing,), {"into": into}))


def test_a_solver_that_takes_blocked_actions_is_found() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Stubborn(Dice):
        def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
            return super().plan(dynamics, evaluator, replace(context, blocked=np.zeros_like(context.blocked)))

    with pytest.raises(PlannerContractBroken, match=r"chose for task \d an action that context\.blocked marks"):
        check_solver(Stubborn)


def test_a_solver_that_remembers_the_first_task_for_all_is_found() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Mixing(Dice):
        def drawn(self, actions: int, context: Any) -> Any:
            sequences = super().drawn(actions, context)
            if context.memory is not None:
                sequences[:, : context.memory.shape[1]] = context.memory[:1]
            return sequences

        def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
            plan = super().plan(dynamics, evaluator, context)
            return replace(plan, memory=plan.candidates)

    with pytest.raises(PlannerContractBroken, match=r"planned task 1 otherwise when it was alone"):
        check_solver(Mixing)


def test_a_solver_that_takes_the_dearest_sequence_is_warned_of() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Contrary(Dice):
        def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
            tree = PrefixTree(dynamics, evaluator, context.observation, self.horizon)
            sequences = self.drawn(tree.actions, context)
            costs = -tree.costs(sequences).min(axis=2)
            blocked = np.take_along_axis(context.blocked, sequences[:, :, 0], axis=1)
            best, price = best_first(sequences, np.where(blocked, np.inf, costs))
            return tree.plan(best, price, [price[:, 0]])

    with pytest.warns(UserWarning, match=r"Contrary: after 4 steps 1\d\d% of the distance to the goal is left"):
        check_solver(Contrary)


@dataclass(frozen=True, kw_only=True)
class Sliding:
    """Draws continuous actions, and imagines and chooses them so many times as large."""

    imagined: ClassVar[float] = 1.0
    chosen: ClassVar[float] = 1.0

    def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
        rollouts = Rollouts(dynamics, evaluator, context.observation)
        shape = 32, 3, dynamics.actions.width
        drawn = np.stack([one.uniform(-1, 1, shape) for one in context.generators]).round() * self.imagined
        best, price = best_first(drawn, rollouts.costs(drawn).min(axis=2))
        return rollouts.plan(best, price, [price[:, 0]], action=best[:, 0, 0] * self.chosen)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"imagined": 1.5}, r"the solver tries the actions -1\.5 to 1\.5; there are -1 to 1"),
        ({"imagined": float("nan")}, r"the solver tries the actions nan to nan; there are -1 to 1"),
        ({"chosen": 1.5}, r"the solver chooses the actions .*; it must be 3 times 2 numbers from -1 to 1"),
    ],
)
def test_continuous_actions_that_do_not_exist_are_found(changed: dict[str, float], said: str) -> None:
    rounded = dict.fromkeys(changed, 1 + 1e-07)
    check_solver(type("Rounding", (Sliding,), rounded), actions=CONTINUOUS)
    with pytest.raises(PlannerContractBroken, match=said):
        check_solver(type("Overshooting", (Sliding,), changed), actions=CONTINUOUS)


def test_a_solver_of_continuous_actions_says_so_where_they_are_discrete() -> None:
    with pytest.raises(InvalidSetting, match="the solver predicts continuous actions, and these are discrete"):
        check_solver(Sliding)
    with pytest.raises(InvalidSetting, match="needs discrete actions, and these are continuous"):
        check_solver(Dice, actions=CONTINUOUS)


def test_settings_are_a_frozen_dataclass_with_defaults() -> None:
    class Plain(Dice):
        pass

    @dataclass
    class Loose:
        weight: float = 1.0

    @dataclass(frozen=True, kw_only=True)
    class Lacking(Dice):
        samples: int = field()  # type: ignore[misc]

    check_solver(Plain)  # it inherits that it is one
    with pytest.raises(PlannerContractBroken, match=r"Loose is no frozen dataclass; write @dataclass\(frozen=True"):
        check_objective(Loose)  # type: ignore[arg-type]
    with pytest.raises(PlannerContractBroken, match=r"Lacking\(\) raised TypeError: .*; a field must have a default"):
        check_solver(Lacking)


@dataclass(frozen=True, kw_only=True)
class Near:
    """The distance of pictures from the goals; tests replace one method of its evaluator."""

    def reset(self, spec: Any, first: Any, goals: Any) -> Any:
        return _Near(goals)


class _Near(Memoryless):
    def __init__(self, goals: Any) -> None:
        self.goals, self.seen = torch.from_numpy(goals.copy()).float(), 0

    def step(self, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
        return StepCost.of(self.apart(dynamics, state, task)), ()

    def apart(self, dynamics: Any, state: Any, task: Any) -> Any:
        shown = (dynamics.frames(state).permute(0, 2, 3, 1) + 1) * 127.5
        return (shown - self.goals[task]).square().mean(dim=(1, 2, 3))


def _counting(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    self.seen += 1
    return StepCost.of(self.apart(dynamics, state, task) + self.seen), ()


def _by_place(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    return StepCost.of(self.apart(dynamics, state, torch.arange(len(task)) % len(self.goals))), ()


def _relative(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    apart = self.apart(dynamics, state, task)
    return StepCost.of(apart / apart.mean()), ()


def _no_number(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    return StepCost.of(self.apart(dynamics, state, task) * float("nan")), ()


def _writing(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    cost = StepCost.of(self.apart(dynamics, state, task))
    state[0].zero_()
    return cost, ()


def _carrying_one(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    return StepCost.of(self.apart(dynamics, state, task)), (torch.zeros(1),)


def _painting(self: Any, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
    shown = dynamics.frames(state)
    return StepCost.of(shown.sub_(self.goals[task].permute(0, 3, 1, 2) / 127.5 - 1).square().mean(dim=(1, 2, 3))), ()


def _blotting(self: Any, actions: Any, frames: Any) -> None:
    frames[:] = 0


def _forging(self: Any, actions: Any, frames: Any) -> None:
    actions[:] = 0


@pytest.mark.parametrize(
    ("method", "instead", "said"),
    [
        ("step", _counting, r"_Near\.step found other costs when it was asked for the same states again"),
        ("step", _by_place, r"_Near\.step found other costs for the same states in another order; row i"),
        ("step", _relative, r"_Near\.step found other costs for task \d when it was alone"),
        ("step", _no_number, r"_Near\.step found a cost that is no finite number"),
        ("step", _writing, r"_Near\.step wrote into the states, tasks, actions or cost_state"),
        ("step", _carrying_one, r"_Near\.step carries on a tensor of the shape \[\(1,\)\]; its first axis"),
        ("step", _painting, r"_Near\.step wrote into what dynamics\.frames or dynamics\.features gave it"),
        ("observe", _blotting, r"_Near\.observe wrote into the images that it was given"),
        ("observe", _forging, r"_Near\.observe wrote into the actions that it was given"),
    ],
)
def test_what_an_objective_breaks_is_found(
    method: str, instead: Callable[..., Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_objective(Near)
    monkeypatch.setattr(_Near, method, instead)
    with pytest.raises(PlannerContractBroken, match=said):
        check_objective(Near)


def test_an_objective_that_counts_the_predicted_steps_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def begin(self: Any, dynamics: Any) -> Any:
        self.seen = 0
        return ()

    monkeypatch.setattr(_Near, "begin", begin)
    monkeypatch.setattr(_Near, "step", _counting)
    with pytest.raises(PlannerContractBroken, match=r"found other costs when it was asked for the same states again"):
        check_objective(Near)


def test_an_objective_to_which_all_states_are_equal_is_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Near, "apart", lambda self, dynamics, state, task: torch.ones(len(task)))
    with pytest.warns(UserWarning, match="Near: a state at the goal costs no less than one at the start"):
        check_objective(Near)


def test_an_objective_that_spoils_the_images_of_a_task_is_found() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Spoiling(Near):
        def reset(self, spec: Any, first: Any, goals: Any) -> Any:
            made = super().reset(spec, first, goals)
            goals[:] = 0
            return made

    with pytest.raises(PlannerContractBroken, match=r"Spoiling\.reset wrote into the images that it was given"):
        check_objective(Spoiling)
