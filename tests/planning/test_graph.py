"""Where no plan gains anything within the horizon, a way through different images is found; else nothing changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
import pytest
import torch
from planning.worlds import PathCost, PerfectGridModel, Walks, context, observed
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.solvers.base import Plan

MOVES = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])
UP, DOWN, LEFT, RIGHT = range(4)
SEARCH = ("samples=30", "elites=5", "horizon=3")
MAZE: Final = """
#########
#...#..G#
#.#.#.#.#
#.#...#.#
#.#####.#
#S.....##
#########
"""
CELLS: Final = np.array([list(line) for line in MAZE.split()])
START: Final = (1, 5)
WAY: Final = [UP] * 4 + [RIGHT] * 2 + [DOWN] * 2 + [RIGHT] * 2 + [UP] * 2 + [RIGHT] * 2
WALL: Final = 2.0
NONE: Final = -9
GOAL: Final = np.argwhere(CELLS.T == "G")[0].tolist()


def drawn(places: Any) -> Any:
    """An image with a white dot where each walker is."""
    images = np.zeros((len(places), *CELLS.shape, 3), np.uint8)
    column, row = np.asarray(places).T
    images[np.arange(len(places)), row.clip(0, len(CELLS) - 1), column.clip(0, CELLS.shape[1] - 1)] = 255
    return images


class MazeCost(PathCost):
    """Nothing at a goal, of which the name of a task says the second one, ``WALL`` in a wall, else 1."""

    def of(self, place: Tensor, history: Tensor, name: Tensor) -> Tensor:
        column, row = (part.numpy() for part in place.T)
        inside = (column >= 0) & (column < CELLS.shape[1]) & (row >= 0) & (row < len(CELLS))
        cell = np.where(inside, CELLS[row.clip(0, len(CELLS) - 1), column.clip(0, CELLS.shape[1] - 1)], "#")
        costs = np.select([cell == "#", cell == "G"], [WALL, 0.0], 1.0)
        return torch.from_numpy(np.where((column == name.numpy()) & (row == START[1]), 0.0, costs))


class Maze(Walks):
    """Walkers in a maze, each with a second goal in the row of the start, or ``NONE``."""

    def __init__(self, goals: tuple[int, ...], places: Any) -> None:
        super().__init__(goals)
        self.evaluator, self._places = MazeCost(self), torch.as_tensor(np.array(places))

    def start(self, observation: Any) -> tuple[Tensor, ...]:
        return self._places, *super().start(observation)[1:]

    def pixels(self, state: tuple[Tensor, ...]) -> Tensor:
        return torch.from_numpy(drawn(state[0]))


def planned(
    name: str, goals: tuple[int, ...], *settings: str, places: Any = None, memory: Any = None, step: int = 0
) -> Plan:
    places = [START] * len(goals) if places is None else places
    observation = replace(observed(drawn(places)), step=step)
    given = context(len(goals), seed=step, memory=memory, observation=observation)
    return Maze(goals, places).plan(make_solver(name, [*SEARCH, *settings]), given)


def walked(name: str, goals: tuple[int, ...], *settings: str, steps: int = len(WAY)) -> list[list[list[int]]]:
    """The places that each walker comes through in some steps, planned one after the other."""
    places, memory, seen = np.array([START] * len(goals)), None, []
    for step in range(steps):
        plan = planned(name, goals, *settings, places=places, memory=memory, step=step)
        places, memory = places + MOVES[plan.action], plan.memory
        seen.append(places)
    walks: list[list[list[int]]] = np.stack(seen, axis=1).tolist()
    return walks


def test_a_way_round_corners_is_found_and_followed() -> None:
    assert GOAL in walked("icem-graph", (NONE,))[0]
    assert GOAL not in walked("icem", (NONE,))[0]
    assert planned("icem-graph", (NONE,)).action.tolist() == [UP]


def test_no_more_states_are_predicted_than_there_are_images() -> None:
    found, icem = planned("icem-graph", (NONE,)), planned("icem", (NONE,))
    free = int((CELLS != "#").sum())
    assert found.frames - icem.frames <= 4 * free + len(MOVES)
    few = planned("icem-graph", (NONE,), "most_states=20")
    assert np.array_equal(few.candidates, icem.candidates)
    assert few.frames - icem.frames <= 20 + 4 * free


@pytest.mark.parametrize("setting", ["depth=13", "alike=100", "least_gain=0"])
def test_where_no_way_is_found_the_plan_is_that_of_icem(setting: str) -> None:
    """The way has 14 actions; where all images are alike none is gone on from; and any plan can gain nothing."""
    found, icem = planned("icem-graph", (NONE,), setting), planned("icem", (NONE,))
    assert np.array_equal(found.candidates, icem.candidates)
    assert found.memory is not None
    assert icem.memory is not None
    assert np.array_equal(found.memory[:, :-1, :3], icem.memory)
    assert (found.memory[:, -1] == -1).all()


def test_what_is_worse_is_no_way() -> None:
    """Through the wall it would be seven actions to the right and four up."""
    through = planned("icem-graph", (NONE,), "most_loss=1")
    assert through.memory is not None
    assert (through.memory[0, -1] >= 0).sum() < len(WAY)


def test_a_plan_that_gains_is_taken_as_it_is() -> None:
    found, icem = (planned(name, (3,)) for name in ("icem-graph", "icem"))
    assert found.action.tolist() == icem.action.tolist() == [RIGHT]
    assert np.array_equal(found.candidates, icem.candidates)
    assert found.frames == icem.frames


def test_a_task_is_planned_the_same_beside_one_that_is_stuck() -> None:
    for goals in ((3, NONE), (NONE, 3)):
        assert walked("icem-graph", goals, steps=9)[0] == walked("icem-graph", goals[:1], steps=9)[0]


def test_a_way_is_followed_between_searches_as_long_as_it_promises_a_gain() -> None:
    before = planned("icem-graph", (NONE,))
    assert before.memory is not None
    assert before.memory[0, -1].tolist() == [*WAY, -1, -1]
    up = np.array([START]) + MOVES[[UP]]
    followed = planned("icem-graph", (NONE,), places=up, memory=before.memory, step=1)
    assert followed.action.tolist() == [UP]
    assert followed.costs[:, 0].tolist() == [0]
    assert followed.candidates[0].tolist() == [WAY[1:4]] * 5
    assert followed.parts["distance"][:, 0].tolist() == [0]
    assert followed.memory is not None
    assert followed.memory[0, -1].tolist() == [*WAY[1:], -1, -1, -1]
    elsewhere = planned("icem-graph", (NONE,), places=[(3, 5)], memory=before.memory, step=1)
    assert elsewhere.memory is not None
    assert (elsewhere.memory[:, -1] == -1).all()  # and none is searched for before step 5
    again = planned("icem-graph", (NONE,), places=[(3, 1)], memory=elsewhere.memory, step=5)
    assert again.action.tolist() == [DOWN]


def test_several_actions_of_a_way_can_be_carried_out_between_plans() -> None:
    before = planned("icem-graph", (NONE,), "replan_every=2")
    carried = planned("icem-graph", (NONE,), "replan_every=2", memory=before.memory, step=1)
    assert carried.frames == 0
    assert carried.action.tolist() == [UP]
    assert carried.memory is not None
    assert carried.memory[0, -1].tolist() == [*WAY[1:], -1, -1, -1]
    assert (carried.candidates >= 0).all()


def test_nothing_else_need_be_remembered() -> None:
    assert GOAL in walked("icem-graph", (NONE,), "kept_elites=0", steps=20)[0]


def test_a_model_that_draws_no_frames_gets_a_sentence() -> None:
    class Blind(PerfectGridModel):
        needs_pixels = False

    frames = np.zeros((1, 128, 128, 3), np.uint8)
    dynamics = ModelDynamics(Blind(), bf16=False)
    state = dynamics.start(observed(frames))
    with pytest.raises(
        InvalidSetting, match=r"^Blind draws no frames, .* plan with '--objective feature --planner icem'"
    ):
        dynamics.pixels(state)


@pytest.mark.parametrize(
    "setting",
    ["depth=0", "most_states=0", "look_every=0", "least_gain=-0.1", "least_gain=1", "alike=-1", "most_loss=-1"],
)
def test_settings_that_cannot_be_are_refused(setting: str) -> None:
    with pytest.raises(InvalidSetting, match=setting.partition("=")[0]):
        make_solver("icem-graph", [setting])
