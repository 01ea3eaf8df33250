"""Stored control tasks as problems: the start state, the goal image, and the distance from the goal.

A start state is reached by replay: the environment is reset with the episode's seed and takes the recorded actions.
The distance that control is judged by comes from the simulator's positions: the sum over objects of how far each is
from its place at the goal, divided by the same at the start, so doing nothing is 1. An object that is lost on the
way counts 1, as much as everything together at the start: a task that loses one cannot count as solved.
The agent's own place does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8

from dmotion_bench.environment import Environment
from dmotion_bench.errors import DatasetError, UnknownName
from dmotion_bench.recording.rollout import make_environment
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, EnvSpec
from dmotion_bench.storage.tasks import ControlTask
from dmotion_bench.wording import command


@runtime_checkable
class TaskDataset(Protocol):
    """What planning needs of a ``storage.dataset.Dataset``."""

    @property
    def path(self) -> Path: ...

    @property
    def name(self) -> str: ...

    @property
    def spec(self) -> EnvSpec: ...

    @property
    def recipe(self) -> DatasetRecipe: ...

    @property
    def fingerprint(self) -> str: ...

    @property
    def rows(self) -> Sequence[Any]: ...

    def tasks(self) -> list[ControlTask]: ...

    def video(self, episode: int) -> UInt8[np.ndarray, "t h w 3"]: ...

    def states(self, episode: int) -> Any: ...


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One control task, with everything that is needed to start it and to judge it.

    Attributes:
        number: Its number among the data set's tasks.
        task: Which frames of which episode it is.
        seed: Of the episode.
        vary: Factors of variation that the episode was recorded with.
        opening: The recorded actions that lead to the start.
        start_frame, goal_frame: What is seen there.
        start_positions, goal_positions: Of the objects [m], NaN for those that are not there.
    """

    number: int
    task: ControlTask
    seed: int
    vary: tuple[str, ...]
    opening: Int[np.ndarray, " t"] | Float[np.ndarray, "t a"]
    start_frame: UInt8[np.ndarray, "h w 3"]
    goal_frame: UInt8[np.ndarray, "h w 3"]
    start_positions: Float[np.ndarray, "k 3"]
    goal_positions: Float[np.ndarray, "k 3"]

    @cached_property
    def initial(self) -> float:
        """Summed distance at the start [m]."""
        return float(np.nansum(self._off(self.start_positions)))

    def distance(self, positions: Float[np.ndarray, "k 3"]) -> float:
        """Normalised distance: 1 at the start, 0 at the goal."""
        off, present = self._off(positions), ~np.isnan(positions[:, 0])
        return float(off[self._counted & present].sum() / self.initial) + self.lost(positions)

    def squared_distance(self, positions: Float[np.ndarray, "k 3"]) -> float:
        """Summed squared distances [m^2]; a lost object is as far away as all objects together at the start."""
        off = np.where(np.isnan(positions[:, 0]), self.initial, self._off(positions))
        return float(np.square(off[self._counted]).sum())

    def lost(self, positions: Float[np.ndarray, "k 3"]) -> int:
        """The number of objects that were lost although the goal needs them."""
        return int((self._counted & np.isnan(positions[:, 0])).sum())

    @cached_property
    def _counted(self) -> Any:
        return ~np.isnan(self.start_positions[:, 0]) & ~np.isnan(self.goal_positions[:, 0])

    def _off(self, positions: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        off: Float[np.ndarray, " k"] = np.linalg.norm(positions - self.goal_positions, axis=-1)
        return off


def load_problems(dataset: TaskDataset, numbers: Sequence[int] | int | None = None) -> list[Problem]:
    """The data set's tasks as problems, in the order asked for.

    Args:
        dataset: With labels.
        numbers: Which tasks; a single number asks for the first so many, None for all.

    Raises:
        DatasetError: The data set stores no tasks.
        UnknownName: There is no task of a number asked for.
        LabelsNotAvailable: ``labels/`` is not there; the recorded actions are in it.
    """
    tasks = dataset.tasks()
    if not tasks:
        raise DatasetError(
            f"{dataset.name!r} stores no control tasks; record a data set with some: "
            f"{command('dmbench record', dataset.recipe.environment, '--tasks', '20')}."
        )
    if numbers is None or isinstance(numbers, int):
        numbers = range(len(tasks) if numbers is None else min(numbers, len(tasks)))
    for number in numbers:
        if not 0 <= number < len(tasks):
            raise UnknownName("task", str(number), [f"0 to {len(tasks) - 1}"])
    return [_problem(dataset, number, tasks[number]) for number in numbers]


def _problem(dataset: TaskDataset, number: int, task: ControlTask) -> Problem:
    video, states = dataset.video(task.episode), dataset.states(task.episode)
    return Problem(
        number=number,
        task=task,
        seed=dataset.rows[task.episode].seed,
        vary=tuple(dataset.recipe.vary),
        opening=states.actions[: task.start],
        start_frame=video[task.start],
        goal_frame=video[task.goal],
        start_positions=states.objects.position[task.start].astype(np.float64),
        goal_positions=states.objects.position[task.goal].astype(np.float64),
    )


def task_environment(recipe: DatasetRecipe) -> Environment:
    """The environment that a data set was recorded in."""
    return make_environment(environment_class(recipe.environment), recipe)


@runtime_checkable
class Moving(Protocol):
    """An environment that tells how far each action moves the agent."""

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each action takes the agent [m]."""


class World:
    """A simulator in which one problem is being solved.

    Args:
        env: For this problem alone, as long as the problem lasts.
        problem: Started at once.

    Attributes:
        actions: Taken since the start.
        frame: What is seen now.
        walls: Places [m] that the agent was found to be kept from.
    """

    def __init__(self, env: Environment, problem: Problem) -> None:
        self.env, self.problem = env, problem
        self.actions: list[int] = []
        self.walls: list[Float[np.ndarray, "2"]] = []
        self.frame = start(env, problem)
        if not np.array_equal(self.frame, problem.start_frame):
            raise DatasetError(
                f"task {problem.number} starts at another picture than the recorded one: the simulator of this machine "
                "does not reproduce the recording, perhaps because its package has another version. Record the data "
                "set again with 'dmbench record'."
            )
        self._look_for_walls()

    def step(self, action: int) -> None:
        """Take an action."""
        self.frame = self.env.step(action)[0]
        self.actions.append(action)
        self._look_for_walls()

    def _look_for_walls(self) -> None:
        if isinstance(self.env, Moving):
            barred = ~self.env.legal_actions()
            self.walls += list(self.env.agent().position[0, :2] + self.env.moves[barred])

    @property
    def distance(self) -> float:
        """Normalised, 1 at the start."""
        return self.problem.distance(self.env.objects().position)

    @property
    def lost(self) -> int:
        """Objects that are gone."""
        return self.problem.lost(self.env.objects().position)


def start(env: Environment, problem: Problem, actions: Sequence[int] = ()) -> UInt8[np.ndarray, "h w 3"]:
    """Bring an environment to a problem's start and take some more actions; returns the image there."""
    frame = env.reset(seed=problem.seed, options={"vary": list(problem.vary)} if problem.vary else None)[0]
    for action in (*problem.opening.tolist(), *actions):
        frame = env.step(action)[0]
    return frame
