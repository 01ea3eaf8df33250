"""What solvers and objectives of one's own do wrong is a sentence that names the class and the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from planning.test_mpc import SMALL, solve
from sound_models import Sound, SoundConfig, breaks

from dmotion_bench.errors import ModelContractBroken, PlannerContractBroken
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.planning.agents import ModelAgent, OracleAgent
from dmotion_bench.planning.dynamics.simulator import SimulatorDynamics
from dmotion_bench.planning.objectives.base import Memoryless, StepCost, taught
from dmotion_bench.planning.objectives.feature import Feature
from dmotion_bench.planning.objectives.pixel import Pixel, PixelEvaluator
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.planning.tasks import Problem
from dmotion_bench.storage.dataset import Dataset
from recorders.grid_things import FACTS
from recorders.grid_world import GridWorld

pytestmark = pytest.mark.slow


class Choosing(CrossEntropy):
    """Plans as always, and then chooses something else."""

    chosen: ClassVar[Any] = None

    def plan(self, *given: Any) -> Any:
        plan = super().plan(*given)
        object.__setattr__(plan, "action", np.array(self.chosen))  # past the check of shapes that tests have
        return None if self.chosen is None else plan


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        (None, "the solver returns 'NoneType'; it must return a Plan"),
        ([-1], r"chooses the actions '\[-1\]'; it must be 1 whole numbers from 0 to 3"),
        ([4], "chooses the actions"),
        ([0, 1], "chooses the actions"),
        ([0.5], "chooses the actions"),
    ],
)
def test_what_a_solver_chooses_is_checked(
    problems: list[Problem], chosen: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Choosing, "chosen", chosen)
    with pytest.raises(PlannerContractBroken, match=said):
        solve(OracleAgent(FACTS, Choosing(samples=3, horizon=2, elites=2), GridWorld), problems[:1], steps=1)


@pytest.mark.parametrize("written", [list, torch.as_tensor])
def test_a_plan_may_hold_lists_and_tensors(
    problems: list[Problem], written: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    as_it_is = CrossEntropy.plan
    usual = solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=2)

    def rewritten(*given: Any) -> Any:
        plan = as_it_is(*given)
        object.__setattr__(plan, "memory", written(plan.candidates))
        for part in ("action", "candidates", "costs", "progress"):
            object.__setattr__(plan, part, written(getattr(plan, part)))
        return plan

    monkeypatch.setattr(CrossEntropy, "plan", rewritten)
    found = solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=2)
    np.testing.assert_array_equal(found.actions, usual.actions)


@pytest.mark.parametrize(
    "memory", [{"a": 1}, [[1, 2], [3]], np.zeros((1, 2)), np.zeros((1, 2, 3)), np.zeros((2, 2, 3), int)]
)
def test_a_memory_is_sequences_of_actions(
    problems: list[Problem], memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_it_is = CrossEntropy.plan

    def remembering(*given: Any) -> Any:
        plan = as_it_is(*given)
        object.__setattr__(plan, "memory", memory)
        return plan

    monkeypatch.setattr(CrossEntropy, "plan", remembering)
    with pytest.raises(
        PlannerContractBroken, match=r"remembers .*it must be None or an array of .* \(1, sequences, steps"
    ):
        solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=1)


@pytest.mark.parametrize(
    ("part", "told", "said"),
    [
        ("memory", np.array([[[0, 4]]]), "remembers the action 4; there are 0 to 3, and -1 for none"),
        ("memory", np.array([[[-2]]]), "remembers the action -2; there are"),
        ("frames", None, "says that it predicted None frames; it must be a whole number from 0 on"),
        ("frames", 2.5, "predicted 2.5 frames"),
        ("frames", -1, "predicted -1 frames"),
        (
            "candidates",
            [[[0, 4]]],
            r"holds the candidates '\[\[\[0, 4\]\]\]'; they must be an array of the shape \(1, seq",
        ),
        ("candidates", np.zeros((1, 0, 3), int), "holds the candidates"),
        ("candidates", [[[0.5]]], "holds the candidates"),
        (
            "costs",
            np.zeros(5),
            r"holds as its costs float64 of the shape \(5,\); it must be numbers of the shape \(1, 5\)",
        ),
        ("costs", np.full((1, 5), np.nan), r"holds costs that are not numbers \(NaN\)"),
        ("progress", None, r"holds as its progress object of the shape \(\); it must be .* \(1, any number\)"),
        ("parts", None, "holds as the parts of its costs 'NoneType'; it must be a dictionary, empty for none"),
        ("parts", {"risk": np.zeros((1, 2))}, r"holds as its part 'risk' of the costs float64 of the shape \(1, 2\)"),
    ],
)
def test_what_nobody_could_keep_or_show_is_refused(
    problems: list[Problem], part: str, told: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_it_is = CrossEntropy.plan

    def telling(*given: Any) -> Any:
        plan = as_it_is(*given)
        object.__setattr__(plan, part, told)
        return plan

    monkeypatch.setattr(CrossEntropy, "plan", telling)
    with pytest.raises(PlannerContractBroken, match=said):
        solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=1)


@pytest.mark.parametrize("sequences", [2, 0])
def test_a_memory_comes_back_as_a_journal_gives_it(
    problems: list[Problem], sequences: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = np.ones((1, sequences, SMALL.horizon), np.int8)
    as_it_is, given_back = CrossEntropy.plan, list[Any]()

    def remembering(self: Any, dynamics: Any, evaluator: Any, context: Any) -> Any:
        given_back.append(context.memory)
        plan = as_it_is(self, dynamics, evaluator, replace(context, memory=None))
        object.__setattr__(plan, "memory", memory)
        return plan

    monkeypatch.setattr(CrossEntropy, "plan", remembering)
    solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=2)
    first, second = given_back
    assert first is None
    if sequences:
        assert second.dtype == np.int64
        np.testing.assert_array_equal(second, memory)
    else:
        assert second is None


def test_a_solver_that_writes_into_what_it_sees_does_so_for_itself(
    problems: list[Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    as_it_is, seen = CrossEntropy.plan, list[Any]()

    def writing(self: Any, dynamics: Any, evaluator: Any, context: Any) -> Any:
        for images in (context.observation.previous, context.observation.current, context.observation.goals):
            seen.append(images.copy())
            images[:] = 0
        return as_it_is(self, dynamics, evaluator, context)

    monkeypatch.setattr(CrossEntropy, "plan", writing)
    solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=2)
    assert all(images.any() for images in seen)


def test_an_objective_that_writes_into_what_was_done_changes_no_record(
    problems: list[Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    as_it_is = solve(OracleAgent(FACTS, SMALL, GridWorld, Pixel()), problems[:2], steps=2)
    assert as_it_is.actions.any()

    def forging(self: Any, actions: Any, frames: Any) -> None:
        actions[:] = 0

    monkeypatch.setattr(PixelEvaluator, "observe", forging)
    found = solve(OracleAgent(FACTS, SMALL, GridWorld, Pixel()), problems[:2], steps=2)
    np.testing.assert_array_equal(found.actions, as_it_is.actions)


def test_costs_that_are_no_numbers_are_refused(problems: list[Problem], monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = SimulatorDynamics.true_costs
    monkeypatch.setattr(SimulatorDynamics, "true_costs", lambda *given: as_it_is(*given) * float("nan"))
    with pytest.raises(PlannerContractBroken, match=r"costs that are not numbers \(NaN\)"):
        solve(OracleAgent(FACTS, SMALL, GridWorld), problems[:1], steps=1)


def test_features_of_a_model_that_diverged_are_the_models_fault(problems: list[Problem]) -> None:
    diverged = breaks(Sound, features=lambda _, state: state[0].mean((2, 3)) * float("nan"))
    model = diverged(SoundConfig(), ModelInputs(height=FACTS.height, width=FACTS.width, actions=FACTS.actions))
    with pytest.raises(ModelContractBroken, match="the model's features of the goal image hold NaN or infinity"):
        solve(ModelAgent(model, FACTS, SMALL, Feature()), problems[:1], steps=1)


class Odd(Memoryless):
    """An objective and its evaluator, one of whose methods returns something else."""

    def __init__(self, method: str = "", answer: Callable[[int], Any] = len) -> None:
        self._method, self._answer = method, answer

    def _of(self, method: str, count: int, usual: Any) -> Any:
        return self._answer(count) if method == self._method else usual

    def reset(self, spec: Any, first: Any, goals: Any) -> Any:
        return self._of("reset", len(first), self)

    def observe(self, actions: Any, frames: Any) -> Any:
        return self._of("observe", len(frames), None)

    def begin(self, dynamics: Any) -> Any:
        return self._of("begin", 1, ())

    def step(self, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
        return self._of("step", len(task), (StepCost.of(torch.zeros(len(task))), ()))


def _raising(_: int) -> Any:
    raise ValueError("no such luck.")


def _cost(count: int, **shapes: tuple[int, ...]) -> Any:
    parts = {name: torch.zeros(shapes.get(name, (count,))) for name in ("distance", "risk", "bonus", "total")}
    cost = StepCost.of(torch.zeros(count))
    for name, part in parts.items():
        object.__setattr__(cost, name, part)  # past the check of shapes that tests have
    return cost, ()


@pytest.mark.parametrize(
    ("method", "answer", "said"),
    [
        (
            "reset",
            _raising,
            r"Odd\.reset raised ValueError in line \d+ of test_planner_contract\.py: no such luck\. The contract",
        ),
        ("observe", _raising, r"Odd\.observe raised ValueError"),
        (
            "observe",
            lambda _: np.stack([]),
            r"Odd\.observe raised ValueError in line \d+ of test_planner_contract\.py: need",
        ),
        ("begin", _raising, r"Odd\.begin raised ValueError"),
        ("step", _raising, r"Odd\.step raised ValueError"),
        ("reset", lambda _: None, r"Odd\.reset returned None, which has no observe and no begin and no step"),
        ("begin", lambda _: None, r"Odd\.begin returned None to carry on; it must be a tuple of tensors"),
        ("step", lambda _: None, r"Odd\.step returned None; it must return a StepCost and a tuple of tensors"),
        ("step", lambda count: _cost(count)[0], r"Odd\.step returned a StepCost; it must return a StepCost and"),
        ("step", lambda count: (torch.zeros(count), ()), r"Odd\.step returned a tuple of 2; it must return a StepCost"),
        ("step", lambda count: (_cost(count)[0], None), r"Odd\.step returned None to carry on"),
        ("step", lambda count: _cost(count, distance=()), r"returned the distance as a tensor of the shape \(\); it"),
        ("step", lambda count: _cost(count, risk=(1,)), r"the risk as a tensor of the shape \(1,\); it must be"),
        ("step", lambda count: _cost(count, bonus=(count, 1)), r"the bonus as a tensor of the shape \(\d, 1\); it"),
        (
            "step",
            lambda count: _cost(count, total=(count // 2,)),
            r"the total as .* must be .* a number for each state",
        ),
    ],
)
def test_what_an_objective_returns_is_checked(
    problems: list[Problem], method: str, answer: Callable[[int], Any], said: str
) -> None:
    solve(OracleAgent(FACTS, SMALL, GridWorld, Odd()), problems[:1], steps=1)
    with pytest.raises(PlannerContractBroken, match=said):
        solve(OracleAgent(FACTS, SMALL, GridWorld, Odd(method, answer)), problems[:1], steps=1)


def test_errors_of_a_solver_and_of_what_learns_from_video_name_them(problems: list[Problem], dataset: Dataset) -> None:
    class Failing:
        plan = learned = reset = staticmethod(lambda *_: _raising(0))

    with pytest.raises(
        PlannerContractBroken, match=r"Failing\.plan raised ValueError in line \d+ of test_planner_contract"
    ):
        solve(OracleAgent(FACTS, Failing(), GridWorld), problems[:1], steps=1)
    with pytest.raises(PlannerContractBroken, match=r"Failing\.learned raised ValueError"):
        taught(Failing(), dataset)


@pytest.mark.parametrize("method", ["begin", "predict", "branch", "frame", "features"])
def test_errors_of_a_model_name_the_model_and_not_the_solver(problems: list[Problem], method: str) -> None:
    failing = breaks(Sound, **{"features": lambda _, state: state[0].mean((2, 3)), method: lambda *_: _raising(0)})
    model = failing(SoundConfig(), ModelInputs(height=FACTS.height, width=FACTS.width, actions=FACTS.actions))
    objective = Feature() if method == "features" else Pixel()
    called = "advance" if method == "predict" else method  # a model of pixels advances by its predict
    with pytest.raises(ModelContractBroken, match=rf"Broken\.{called} raised ValueError in line .* no such luck\. The"):
        solve(ModelAgent(model, FACTS, SMALL, objective), problems[:1], steps=1)
