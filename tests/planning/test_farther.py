"""Where no plan gains anything within the horizon, a longer one is tried; else nothing changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from planning.worlds import PathCost, Walks, context
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.solvers.base import Plan
from dmotion_bench.planning.solvers.farther import FartherCrossEntropy

MOVES = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])
SEARCH = ("samples=30", "elites=5", "cost_at=last")


class Plateau(PathCost):
    """Costs nothing from so many steps to the right on as the task's name says, and 1 before."""

    def of(self, place: Tensor, history: Tensor, name: Tensor) -> Tensor:
        return (place[:, 0] < name).double()


class PlateauWalks(Walks):
    """The lattice, where each task's walker stands somewhere else."""

    def __init__(self, distances: tuple[int, ...], places: Any) -> None:
        super().__init__(distances)
        self.evaluator, self._places = Plateau(self), torch.as_tensor(np.array(places))

    def start(self, observation: Any) -> tuple[Tensor, ...]:
        return self._places, *super().start(observation)[1:]


def walked(name: str, distances: tuple[int, ...], steps: int, settings: tuple[str, ...] = SEARCH) -> list[int]:
    """How far right the walkers are after some steps, planned one after the other."""
    solver, memory, places = make_solver(name, [*settings, "horizon=3"]), None, np.zeros((len(distances), 2), int)
    for step in range(steps):
        walks = PlateauWalks(distances, places)
        plan = walks.plan(solver, context(len(distances), seed=step, memory=memory))
        places, memory = places + MOVES[plan.action], plan.memory
    return [int(place) for place in places[:, 0]]


def planned(solver: Any, distances: tuple[int, ...]) -> Plan:
    return PlateauWalks(distances, np.zeros((len(distances), 2), int)).plan(solver, context(len(distances)))


def test_what_is_out_of_reach_of_short_plans_is_reached() -> None:
    assert walked("icem-farther", (10,), 12)[0] >= 10
    assert walked("icem", (10,), 12)[0] < 10  # whatever it does, it costs 1


def test_a_plan_that_gains_is_taken_as_it_is() -> None:
    near, far = (planned(make_solver(name, [*SEARCH, "horizon=3"]), (2,)) for name in ("icem", "icem-farther"))
    assert far.action.tolist() == near.action.tolist()
    assert np.array_equal(far.candidates, near.candidates)
    assert far.memory is not None
    assert near.memory is not None
    assert np.array_equal(far.memory[:, :, :3], near.memory)


def test_where_no_horizon_gains_anything_the_nearest_decides() -> None:
    near, far = (planned(make_solver(name, [*SEARCH, "horizon=3"]), (99,)) for name in ("icem", "icem-farther"))
    assert np.array_equal(far.candidates, near.candidates)


def test_a_task_is_planned_the_same_beside_one_that_is_stuck() -> None:
    assert walked("icem-farther", (2, 10), 6)[0] == walked("icem-farther", (2,), 6)[0]
    assert walked("icem-farther", (10, 2), 6)[0] == walked("icem-farther", (10,), 6)[0]


def test_one_horizon_and_a_small_enough_gain_are_icem() -> None:
    icem = planned(make_solver("icem", [*SEARCH, "horizon=3"]), (5,))
    for setting in ("scales=1", "least_gain=0"):
        same = planned(make_solver("icem-farther", [*SEARCH, "horizon=3", setting]), (5,))
        assert np.array_equal(same.candidates, icem.candidates)


def test_a_plan_is_carried_out_between_searches() -> None:
    solver = FartherCrossEntropy(horizon=3, samples=30, elites=5, cost_at="last", replan_every=2)
    walks = PlateauWalks((10,), np.zeros((1, 2), int))
    plan = walks.plan(solver, context(1))
    given = context(1, memory=plan.memory)
    given = replace(given, observation=replace(given.observation, step=1))
    carried = walks.plan(solver, given)
    assert carried.frames == 0
    assert plan.memory is not None
    assert carried.action.tolist() == plan.memory[:, 0, 1].tolist()


def between(memory: Any) -> Plan:
    """The plan of the step after a search with longer horizons, whose best sequence leads 10 steps to the right."""
    walks = PlateauWalks((10,), np.array([[1, 0]]))
    given = context(1, memory=memory)
    solver = FartherCrossEntropy(horizon=3, samples=30, elites=5, cost_at="last")
    return walks.plan(solver, replace(given, observation=replace(given.observation, step=1)))


def test_a_long_plan_is_carried_on_between_searches() -> None:
    right, left = 3, 2
    known = np.full((1, 5, 12), right)
    known[:, 1:] = left
    plan = between(known)
    assert plan.action.tolist() == [right]
    assert plan.costs[:, 0].tolist() == [0]
    assert plan.memory is not None
    assert (plan.memory == right).all()
    assert plan.candidates.shape == (1, 5, 3)
    assert between(np.full((1, 5, 12), left)).costs[:, 0].tolist() == [1]  # and nothing longer is searched for


@pytest.mark.parametrize("setting", ["scales=0", "farther_every=0", "least_gain=-0.1", "least_gain=1"])
def test_settings_that_cannot_be_are_refused(setting: str) -> None:
    with pytest.raises(InvalidSetting, match=setting.partition("=")[0]):
        make_solver("icem-farther", [setting])
