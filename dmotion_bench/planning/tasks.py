"""Stored control tasks as problems: the start state, the goal image, and the distance from the goal.

A start state is reached by replay: the environment is reset with the episode's seed and takes the recorded actions.
The goal is a later frame of the episode, unless the environment sets one itself (``environment.SetsGoal``).

The distance that control is judged by is the environment's to supply (``environment.Judging``): 1 at the start, 0 at
the goal. Where it supplies none, it comes from the simulator's positions: the sum over objects of how far each is from
its place at the goal, divided by the same at the start. An object that is lost on the way counts 1, as much as
everything together at the start: a task that loses one cannot count as solved. The agent's own place does not count.

An environment that tells no positions is judged by its pictures: the mean squared difference of the frame from the goal
image, divided by the same at the start. A figure of that kind has a name of its own (``Judge``).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int, UInt8

from dmotion_bench.actions import ActionTaken, as_actions, given
from dmotion_bench.environment import Environment, Judging, ObjectEnvironment, SetsGoal, TaskMeasure
from dmotion_bench.errors import DatasetError, DmbenchError, RecordingFailed, UnknownName
from dmotion_bench.recording.failures import guarded
from dmotion_bench.recording.rollout import make_environment, require_picture
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, ObjectStates, delay_of
from dmotion_bench.storage.manifest import setting_words
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.tasks import ControlTask
from dmotion_bench.wording import command


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
        start_objects, goal_objects: The objects there; where frames lag behind the world, the goal's are those that
            the goal's frame shows.
    """

    number: int
    task: ControlTask
    seed: int
    vary: tuple[str, ...]
    opening: Int[np.ndarray, " t"] | Float[np.ndarray, "t a"]
    start_frame: UInt8[np.ndarray, "h w 3"]
    goal_frame: UInt8[np.ndarray, "h w 3"]
    start_objects: ObjectStates
    goal_objects: ObjectStates


class Judge(StrEnum):
    """What judges how far a task is from its goal."""

    OWN = "environment"  # Judging.task_measure
    OBJECTS = "objects"
    PICTURES = "pictures"


class ObjectDistances:
    """The judged distance of environments that supply none: how far the objects are from their places at the goal.

    Args:
        start, goal: The objects at a task's start and goal.
    """

    def __init__(self, start: ObjectStates, goal: ObjectStates) -> None:
        self._goal = goal.position
        self._counted = ~np.isnan(start.position[:, 0]) & ~np.isnan(goal.position[:, 0])
        self._initial = float(np.nansum(self._off(start.position)))

    def distance(self, env: Environment) -> float:
        """Summed over objects, divided by the same at the start; a lost object adds 1."""
        positions = _positions(env)
        off, present = self._off(positions), ~np.isnan(positions[:, 0])
        return float(off[self._counted & present].sum() / self._initial) + self.lost(env)

    def lost(self, env: Environment) -> int:
        """The number of objects that were lost although the goal needs them."""
        return int((self._counted & np.isnan(_positions(env)[:, 0])).sum())

    def cost(self, env: Environment) -> float:
        """Summed squared distances [m^2]; a lost object is as far away as all objects together at the start."""
        positions = _positions(env)
        off = np.where(np.isnan(positions[:, 0]), self._initial, self._off(positions))
        return float(np.square(off[self._counted]).sum())

    def _off(self, positions: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        off: Float[np.ndarray, " k"] = np.linalg.norm(positions - self._goal, axis=-1)
        return off


def _positions(env: Environment) -> Float[np.ndarray, "k 3"]:
    """Of the objects [m]; whoever judges by objects has asked whether the environment tells them (``judge_of``).

    It is not asked again here, because ``isinstance`` with a protocol takes longer than the objects do.

    Raises:
        RecordingFailed: It tells the positions of other objects than its facts name, or none.
    """
    told: Any = cast(ObjectEnvironment, env).objects()
    wanted = (len(env.facts.objects), 3)
    if not isinstance(told, ObjectStates) or np.shape(told.position) != wanted:
        found = np.shape(told.position) if isinstance(told, ObjectStates) else type(told).__name__
        raise RecordingFailed(
            f"the environment {env.facts.id!r} tells {found} where its objects are, in a control task; 'objects' must "
            f"return a dmotion_bench.specs.ObjectStates with positions of the shape {wanted}."
        )
    return told.position


class PictureDistance:
    """The judged distance of environments that tell no positions: how different the frame is from the goal image.

    Nothing is known about what the difference is of: the agent counts as much as the same number of other pixels.

    Args:
        start, goal: What is seen at a task's start and goal.
    """

    def __init__(self, start: UInt8[np.ndarray, "h w 3"], goal: UInt8[np.ndarray, "h w 3"]) -> None:
        self._goal = goal.astype(np.float64)
        self._initial = self._off(start)

    def distance(self, env: Environment) -> float:
        """Mean squared difference from the goal image, divided by the same at the start."""
        return self.cost(env) / self._initial if self._initial else 0.0

    def lost(self, env: Environment) -> int:
        """Nothing: a picture does not tell."""
        return 0

    def cost(self, env: Environment) -> float:
        """Mean squared difference from the goal image, of pixel values 0-255."""
        return self._off(env.render())

    def _off(self, frame: UInt8[np.ndarray, "h w 3"]) -> float:
        return float(np.square(frame - self._goal).mean())


def judge_of(env: Environment) -> Judge:
    """What judges the tasks of an environment."""
    if isinstance(env, Judging):
        return Judge.OWN
    return Judge.OBJECTS if env.facts.objects and isinstance(env, ObjectEnvironment) else Judge.PICTURES


def measure_of(env: Environment, problem: Problem) -> TaskMeasure:
    """How the environment judges a problem, or in its stead its objects or its pictures."""
    if isinstance(env, Judging):
        return env.task_measure(problem.start_objects, problem.goal_objects)
    if judge_of(env) is Judge.OBJECTS:
        return ObjectDistances(problem.start_objects, problem.goal_objects)
    return PictureDistance(problem.start_frame, problem.goal_frame)


def judged_distance(measure: TaskMeasure, env: Environment, problem: Problem) -> float:
    """How far an environment is from a problem's goal: 1 at the start, 0 at the goal.

    Raises:
        RecordingFailed: The environment raises something when it is asked.
        DmbenchError: It is no finite number, which a mean over tasks would leave out.
    """
    with asking(env, problem):
        distance = float(measure.distance(env))
    if not math.isfinite(distance):
        raise DmbenchError(
            f"the environment {env.facts.id!r} judges task {problem.number} to be {distance} away from its goal; a "
            "judged distance must be a finite number, 1 at the start."
        )
    return distance


def load_problems(dataset: ReadableDataset, numbers: Sequence[int] | int | None = None) -> list[Problem]:
    """The data set's tasks as problems, in the order asked for.

    Args:
        dataset: With labels.
        numbers: Which tasks; a single number asks for the first so many, None for all.

    Raises:
        DatasetError: The data set stores no tasks.
        UnknownName: There is no task of a number asked for.
        LabelsNotAvailable: ``labels/`` is not there; the recorded actions are in it.
    """
    tasks, recipe = dataset.tasks(), dataset.recipe
    if not tasks and recipe.tasks:
        raise DatasetError(
            f"{dataset.name!r} stores none of the {recipe.tasks} control tasks that were asked for: its environment or "
            "policy does not repeat, as its recording said, or none of its episodes is long enough, or moves objects; "
            "record more or longer ones with '--episodes' and '--frames'."
        )
    if not tasks:
        raise DatasetError(
            f"{dataset.name!r} stores no control tasks; record a data set with some: "
            f"{command('dmbench record', recipe.environment, *setting_words(recipe), '--tasks', '20')}."
        )
    if numbers is None or isinstance(numbers, int):
        numbers = range(len(tasks) if numbers is None else min(numbers, len(tasks)))
    for number in numbers:
        if not 0 <= number < len(tasks):
            raise UnknownName("task", str(number), [f"0 to {len(tasks) - 1}"])
    return as_problems(dataset, {number: tasks[number] for number in numbers})


def as_problems(
    dataset: ReadableDataset, tasks: Mapping[int, ControlTask], *, recorded_goals: bool = False
) -> list[Problem]:
    """Stretches of recorded episodes as problems, whether they are stored as tasks or not.

    Args:
        dataset: With labels.
        tasks: By the numbers that the problems are to have.
        recorded_goals: Whether ``has_recorded_goals`` is known to hold, so that the environment need not be here.

    Raises:
        LabelsNotAvailable: ``labels/`` is not there; the recorded actions are in it.
        UnknownName, PackageNotInstalled, DmbenchError: The environment is asked, and is not here.
    """
    problems = [_problem(dataset, number, task) for number, task in tasks.items()]
    if recorded_goals or has_recorded_goals(dataset.recipe):
        return problems
    return _with_own_goals(dataset.recipe, problems)


def has_recorded_goals(recipe: DatasetRecipe) -> bool:
    """Whether the goals of tasks are recorded frames, since the environment sets none itself.

    Raises:
        UnknownName, PackageNotInstalled, DmbenchError: The environment is not here.
    """
    kind: object = environment_class(recipe.environment)
    return not isinstance(kind, SetsGoal)


def _with_own_goals(recipe: DatasetRecipe, problems: list[Problem]) -> list[Problem]:
    """The problems with the goals that the environment sets itself."""
    env = task_environment(recipe)
    try:
        return [_with_own_goal(env, problem) for problem in problems]
    finally:
        env.close()


def _with_own_goal(env: Environment, problem: Problem) -> Problem:
    start(env, replace(problem, opening=problem.opening[:0]))
    with _guarded(env, "'task_goal'", lambda: f"for task {problem.number}"):
        goal = env.task_goal() if isinstance(env, SetsGoal) else None
        if goal is None:
            return problem
        picture, objects = goal
    require_picture(env.facts, picture)
    return replace(problem, goal_frame=picture, goal_objects=objects)


def _options(problem: Problem) -> dict[str, list[str]] | None:
    """What a problem's episode is reset with, besides its seed."""
    return {"vary": list(problem.vary)} if problem.vary else None


def _problem(dataset: ReadableDataset, number: int, task: ControlTask) -> Problem:
    video, states = dataset.video(task.episode), dataset.states(task.episode)
    shown, seen = (_at(states.objects, step) for step in (max(0, task.goal - delay_of(states.factors)), task.goal))
    return Problem(
        number=number,
        task=task,
        seed=dataset.rows[task.episode].seed,
        vary=tuple(dataset.recipe.vary),
        opening=states.actions[: task.start],
        start_frame=video[task.start],
        goal_frame=video[task.goal],
        start_objects=_at(states.objects, task.start),
        goal_objects=replace(shown, pixel=seen.pixel, visible=seen.visible),
    )


def _at(states: ObjectStates, step: int) -> ObjectStates:
    """The states at one moment of an episode."""
    return ObjectStates(**{one.name: getattr(states, one.name)[step].astype(np.float64) for one in fields(states)})


def task_environment(recipe: DatasetRecipe) -> Environment:
    """The environment that a data set was recorded in."""
    return make_environment(environment_class(recipe.environment), recipe)


class World:
    """A simulator in which one problem is being solved.

    Args:
        env: For this problem alone, as long as the problem lasts.
        problem: Started at once.

    Attributes:
        actions: Taken since the start.
        frame: What is seen now.
    """

    def __init__(self, env: Environment, problem: Problem) -> None:
        self.env, self.problem = env, problem
        self.actions: list[ActionTaken] = []
        self.frame = start(env, problem)
        with asking(env, problem):
            self._measure = measure_of(env, problem)
        if not np.array_equal(self.frame, problem.start_frame):
            raise DatasetError(
                f"task {problem.number} starts at another picture than the recorded one: the simulator of this machine "
                "does not reproduce the recording, perhaps because its package has another version. Record the data "
                "set again with 'dmbench record'."
            )

    def step(self, action: ActionTaken) -> None:
        """Take an action."""
        self.frame = take(self.env, action)
        self.actions.append(action)

    @property
    def distance(self) -> float:
        """Normalised, 1 at the start; errors as of ``judged_distance``."""
        return judged_distance(self._measure, self.env, self.problem)

    @property
    def lost(self) -> int:
        """Objects that are gone; errors as of ``judged_distance``."""
        with asking(self.env, self.problem):
            return int(self._measure.lost(self.env))


def start(env: Environment, problem: Problem, actions: Sequence[ActionTaken] = ()) -> UInt8[np.ndarray, "h w 3"]:
    """Bring an environment to a problem's start and take some more actions; returns the image there.

    Raises:
        RecordingFailed: As ``take``.
    """
    with _guarded(env, "'reset'", lambda: f"at the start of task {problem.number}"):
        frame: UInt8[np.ndarray, "h w 3"] = env.reset(seed=problem.seed, options=_options(problem))[0]
    require_picture(env.facts, frame)
    for action in (*as_actions(problem.opening), *actions):
        frame = take(env, action)
    return frame


def take(env: Environment, action: ActionTaken) -> UInt8[np.ndarray, "h w 3"]:
    """Take an action; returns the image after it.

    Raises:
        RecordingFailed: The environment raises something, or draws no picture as its facts say; a task may go on beyond
            the end of its episode.
    """
    with _guarded(env, "'step'", lambda: f"in a control task, at the action {action}"):
        frame: UInt8[np.ndarray, "h w 3"] = env.step(given(action))[0]
    require_picture(env.facts, frame)
    return frame


def asking(env: Environment, problem: Problem) -> contextlib.AbstractContextManager[None]:
    """Turn what an environment raises when it is asked about its state into a sentence.

    Raises:
        RecordingFailed: It raises something else than a ``DmbenchError``.
    """
    return _guarded(env, "what it tells of its state", lambda: f"in control task {problem.number}")


def _guarded(env: Environment, method: str, when: Callable[[], str]) -> contextlib.AbstractContextManager[None]:
    """Turn what somebody else's environment raises into a sentence."""
    return guarded(f"the environment {env.facts.id!r}", method, when)
