"""The control loop: observe, plan, act, a hundred times, for many tasks at once.

Tasks are worked on in groups, side by side, so that a model predicts for all of them in one batch. What a task comes
to depends on the data set, the weights, the solver, the objective and the seed; the groups only decide which numbers
are rounded together.

Interrupted and started again, the loop goes on: what it has to keep is the actions that were taken, since a state is
a seed and actions.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.actions import ActionSpec, Discrete, as_actions
from dmotion_bench.environment import Environment
from dmotion_bench.planning.agents import Agent, Decision, SimulatorAgent, known_actions, was_taken
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.planning.experience import Experience
from dmotion_bench.planning.journal import Journal, TaskRecord, as_array
from dmotion_bench.planning.objectives.base import Taken
from dmotion_bench.planning.solvers.base import PlanContext
from dmotion_bench.planning.tasks import Judge, Problem, World, judge_of
from dmotion_bench.values import require_bounds

CONTROL_VERSION: Final = 1
"""The version of control: of the loop, the solvers, the objectives, the references and the judged distance.

Raise it when a change makes anybody take another action, or gives another distance, in any task with the same
settings. ``tests/golden/control.json`` holds actions and distances to notice that by. Results of different versions
are neither averaged nor compared. A solver or objective that is new and leaves the others as they are needs no new
version.
"""

STEPS = 100
GROUP = 4
"""Tasks side by side on a CPU: a state of a model takes some 400 KB, and a plan holds hundreds of them per task."""


@dataclass(frozen=True, kw_only=True)
class ControlSettings:
    """The settings that decide the result, besides the agent and the data.

    Attributes:
        steps: Actions a task.
        seed: Of the solver's random numbers.
        group: Tasks side by side.
    """

    steps: int = STEPS
    seed: int = 0
    group: int = GROUP

    def __post_init__(self) -> None:
        require_bounds(self, from_one=("steps", "group"), from_zero=("seed",))


@dataclass(frozen=True, kw_only=True)
class ControlProgress:
    """The progress of the control loop.

    Attributes:
        steps, total: Control steps done, of all tasks together.
        distance: Mean normalised distance of the tasks that are done; NaN before the first.
    """

    steps: int
    total: int
    distance: float


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One control step as ``watch`` is given it, before the actions are taken."""

    context: PlanContext
    decision: Decision
    worlds: Sequence[World]
    distance: Float[np.ndarray, " b"]


@dataclass(frozen=True, kw_only=True)
class ControlResult:
    """The results of all tasks.

    Attributes:
        tasks: Their numbers.
        episodes, starts: The episodes they are cut out of, and the frame there that they start at.
        distance: Normalised, at the start and after each step.
        lost: Objects that are gone, likewise.
        actions: Taken; ``NO_ACTION``, or of continuous actions NaN, where none was.
        frames: Predicted in all.
        seconds: Of planning alone; of this run of the program.
        planned: Control steps that ``seconds`` went into.
        judge: What the distance is of.
    """

    tasks: tuple[int, ...]
    episodes: tuple[int, ...]
    starts: tuple[int, ...]
    distance: Float[np.ndarray, "n moments"]
    lost: Int[np.ndarray, "n moments"]
    actions: Int[np.ndarray, "n t"] | Float[np.ndarray, "n t a"]
    frames: int
    seconds: float
    planned: int
    judge: Judge = Judge.OBJECTS


@dataclass(kw_only=True)
class _Loop:
    """The state that all groups of tasks share."""

    agent: Agent
    settings: ControlSettings
    actions: ActionSpec
    journal: Journal
    watch: Callable[[Scene], None]
    on_progress: Callable[[], None]
    envs: list[Environment]
    seconds: float = 0.0
    planned: int = 0
    records: dict[int, TaskRecord] = field(default_factory=dict)


def control(
    agent: Agent,
    problems: Sequence[Problem],
    make_env: Callable[[], Environment],
    settings: ControlSettings | None = None,
    *,
    journal: Journal | None = None,
    watch: Callable[[Scene], None] = lambda _: None,
    on_progress: Callable[[ControlProgress], None] = lambda _: None,
) -> ControlResult:
    """Solve the problems as well as the agent can.

    Args:
        agent: Chooses the actions.
        problems: To be solved.
        make_env: Makes a simulator; as many as tasks stand side by side.
        settings: Steps, seed, tasks side by side.
        journal: Where progress is kept, to go on from it; nowhere by default.
        watch: Called at every control step.
        on_progress: Called after every control step.
    """
    settings = settings or ControlSettings()
    groups = [problems[first : first + settings.group] for first in range(0, len(problems), settings.group)]
    envs = list[Environment]()
    with contextlib.ExitStack() as opened:
        for _ in range(min(settings.group, len(problems))):
            envs.append(make_env())
            opened.callback(envs[-1].close)
        opened.callback(agent.close)
        loop = _Loop(
            agent=agent,
            settings=settings,
            actions=known_actions(envs[0].facts) if envs else Discrete.numbered(1),
            journal=journal or Journal.nowhere(),
            watch=watch,
            on_progress=lambda: on_progress(_progress(loop.records, settings, len(problems))),
            envs=envs,
        )
        for group in groups:
            _solve(loop, group)
    records = [loop.records[problem.number] for problem in problems]
    moments = len(records[0].distance) if records else settings.steps + 1
    return ControlResult(
        tasks=tuple(problem.number for problem in problems),
        episodes=tuple(problem.task.episode for problem in problems),
        starts=tuple(problem.task.start for problem in problems),
        distance=np.array([record.distance for record in records]).reshape(len(records), moments),
        lost=np.array([record.lost for record in records], np.int64).reshape(len(records), moments),
        actions=as_array(loop.actions, records),
        frames=sum(record.frames for record in records),
        seconds=loop.seconds,
        planned=loop.planned,
        judge=judge_of(envs[0]) if envs else Judge.OBJECTS,
    )


def _solve(loop: _Loop, problems: Sequence[Problem]) -> None:
    """Solve one group of tasks, starting from the step that the journal has reached."""
    records = loop.journal.records(problems)
    loop.records.update(records)
    done = min(len(record.actions) for record in records.values())
    if done >= loop.settings.steps:
        loop.on_progress()
        return
    group = _Group(loop, problems)
    memory = loop.journal.memory(problems) if done else None  # a group that begins anew remembers nothing
    for past in as_array(loop.actions, records.values()).swapaxes(0, 1):
        group.act(past)
    for record, world in zip(records.values(), group.worlds, strict=True):
        if not record.distance:
            record.note(world)
    for step in range(done, loop.settings.steps):
        context = PlanContext(
            observation=group.observation(step),
            generators=tuple(task_generator(loop.settings.seed, problem, step) for problem in problems),
            blocked=group.blocked.copy(),
            memory=memory,
            experience=group.experience,
        )
        began = time.perf_counter()
        decision = group.decide(context)
        loop.seconds += time.perf_counter() - began
        loop.planned += len(problems)
        distance = np.array([world.distance for world in group.worlds])
        loop.watch(Scene(context=context, decision=decision, worlds=group.worlds, distance=distance))
        group.act(decision.action)
        memory, frames = (decision.plan.memory, decision.plan.frames) if decision.plan else (None, 0)
        for place, (record, world) in enumerate(zip(records.values(), group.worlds, strict=True)):
            record.took(decision.action[place])
            record.frames += frames // len(problems) + (place < frames % len(problems))
            record.note(world)
        loop.journal.write(records, memory, last=step + 1 == loop.settings.steps)
        loop.on_progress()


class _Group:
    """Some tasks side by side, and what their agent sees: images alone, unless it declares that it needs more.

    Attributes:
        worlds: Their simulators.
        blocked: Actions that left the image as it is, since it last changed.
        experience: What was seen to follow what.
    """

    def __init__(self, loop: _Loop, problems: Sequence[Problem]) -> None:
        self._agent = loop.agent
        self.worlds = [World(env, problem) for env, problem in zip(loop.envs, problems, strict=False)]
        self._goals = np.stack([problem.goal_frame for problem in problems])
        self._current = self._previous = np.stack([world.frame for world in self.worlds])
        count = len(loop.actions) if isinstance(loop.actions, Discrete) else 0
        self.blocked: Bool[np.ndarray, "b a"] = np.zeros((len(problems), count), np.bool_)
        self.experience = Experience(self._current, count)
        self._agent.reset(self._current.copy(), self._goals.copy())
        self._show()

    def observation(self, step: int) -> Observation:
        """What an agent is given after ``step`` actions: images of its own, whatever it does with them."""
        previous, current, goals = (images.copy() for images in (self._previous, self._current, self._goals))
        return Observation(previous=previous, current=current, goals=goals, step=step)

    def decide(self, context: PlanContext) -> Decision:
        """Ask the agent for its actions; only references that declare it are given the simulators."""
        if isinstance(self._agent, SimulatorAgent):
            return self._agent.act_in(context, self.worlds)
        return self._agent.act(context)

    def act(self, actions: Taken) -> None:
        """Take actions, and let the agent see what they lead to."""
        taken = was_taken(actions)
        for world, action, is_one in zip(self.worlds, as_actions(actions), taken.tolist(), strict=True):
            if is_one:
                world.step(action)
        frames = np.stack([world.frame for world in self.worlds])
        changed = (frames != self._current).any(axis=(1, 2, 3))
        self.blocked[changed] = False
        if self.blocked.shape[1]:
            for place in np.flatnonzero(~changed & taken).tolist():
                self.blocked[place, actions[place]] = True
        self.experience.took(actions, frames)
        self._previous = np.where(changed[:, None, None, None], self._current, self._previous)
        self._current = frames
        self._agent.observe(actions.copy(), frames.copy())  # an objective may write into them
        self._show()

    def _show(self) -> None:
        if isinstance(self._agent, SimulatorAgent):
            self._agent.watch(self.worlds)


def task_generator(seed: int, problem: Problem, step: int) -> np.random.Generator:
    """The random number generator of one task at one step; it does not depend on the other tasks."""
    return np.random.default_rng([seed, problem.task.episode, problem.task.start, step])


def _progress(records: Mapping[int, TaskRecord], settings: ControlSettings, tasks: int) -> ControlProgress:
    done = [record.distance[-1] for record in records.values() if len(record.actions) >= settings.steps]
    return ControlProgress(
        steps=sum(len(record.actions) for record in records.values()),
        total=tasks * settings.steps,
        distance=float(np.mean(done)) if done else float("nan"),
    )
