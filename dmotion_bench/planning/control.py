"""The control loop: observe, plan, act, a hundred times, for many tasks at once.

Tasks are worked on in groups, side by side, so that a model sees their futures in one batch. What a task comes to
depends on the data set, the weights, the planner and the seed; the groups only decide which numbers are rounded
together.

Interrupted and started again, the loop goes on: what it has to keep is the actions that were taken, since a state is
a seed and actions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.actions import require_discrete
from dmotion_bench.environment import Environment
from dmotion_bench.planning.controllers import NO_ACTION, Controller, Decision, KnowsSimulator, Seen
from dmotion_bench.planning.exploring import Sights
from dmotion_bench.planning.journal import Journal, TaskRecord
from dmotion_bench.planning.problems import Problem, World
from dmotion_bench.planning.tracking import Tracker
from dmotion_bench.specs import EnvSpec

CONTROL_VERSION: Final = 1
"""The version of control: of the loop, the planners, the costs, the references and the judged distance.

Raise it when a change makes anybody take another action, or gives another distance, in any task with the same
settings. ``tests/golden/control.json`` holds actions and distances to notice that by. Results of different versions
are neither averaged nor compared. A planner or cost that is new and leaves the others as they are needs no new version.
"""

STEPS = 100
GROUP = 4
"""Tasks side by side on a CPU: a state of a model takes some 400 KB, and a plan holds hundreds of them per task."""


@dataclass(frozen=True, kw_only=True)
class ControlSettings:
    """The settings that decide the result, besides the controller and the data.

    Attributes:
        steps: Actions a task.
        seed: Of the planner's random numbers.
        group: Tasks side by side.
    """

    steps: int = STEPS
    seed: int = 0
    group: int = GROUP

    def __post_init__(self) -> None:
        from dmotion_bench.errors import InvalidSetting

        if self.steps < 1 or self.group < 1:
            raise InvalidSetting(f"steps is {self.steps} and group {self.group}; both must be 1 or more.")


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

    seen: Seen
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
        actions: Taken; ``NO_ACTION`` where none was.
        frames: Imagined in all.
        seconds: Of planning alone; of this run of the program.
        planned: Control steps that ``seconds`` went into.
    """

    tasks: tuple[int, ...]
    episodes: tuple[int, ...]
    starts: tuple[int, ...]
    distance: Float[np.ndarray, "n moments"]
    lost: Int[np.ndarray, "n moments"]
    actions: Int[np.ndarray, "n t"]
    frames: int
    seconds: float
    planned: int


@dataclass(kw_only=True)
class _Loop:
    """The state that all groups of tasks share."""

    controller: Controller
    settings: ControlSettings
    actions: int
    journal: Journal
    watch: Callable[[Scene], None]
    on_progress: Callable[[], None]
    envs: list[Environment]
    seconds: float = 0.0
    planned: int = 0
    records: dict[int, TaskRecord] = field(default_factory=dict)


def control(
    controller: Controller,
    problems: Sequence[Problem],
    make_env: Callable[[], Environment],
    settings: ControlSettings | None = None,
    *,
    journal: Journal | None = None,
    watch: Callable[[Scene], None] = lambda _: None,
    on_progress: Callable[[ControlProgress], None] = lambda _: None,
) -> ControlResult:
    """Solve the problems as well as the controller can.

    Args:
        controller: Chooses the actions.
        problems: To be solved.
        make_env: Makes a simulator; as many as tasks stand side by side.
        settings: Steps, seed, tasks side by side.
        journal: Where progress is kept, to go on from it; nowhere by default.
        watch: Called at every control step.
        on_progress: Called after every control step.
    """
    settings = settings or ControlSettings()
    groups = [problems[first : first + settings.group] for first in range(0, len(problems), settings.group)]
    envs = [make_env() for _ in range(min(settings.group, len(problems)))]
    loop = _Loop(
        controller=controller,
        settings=settings,
        actions=len(require_discrete(envs[0].facts.actions, "planning")) if envs else 0,
        journal=journal or Journal.nowhere(),
        watch=watch,
        on_progress=lambda: on_progress(_progress(loop.records, settings, len(problems))),
        envs=envs,
    )
    try:
        for group in groups:
            _solve(loop, group)
    finally:
        for env in envs:
            env.close()
    records = [loop.records[problem.number] for problem in problems]
    return ControlResult(
        tasks=tuple(problem.number for problem in problems),
        episodes=tuple(problem.task.episode for problem in problems),
        starts=tuple(problem.task.start for problem in problems),
        distance=np.array([record.distance for record in records]).reshape(len(records), -1),
        lost=np.array([record.lost for record in records], np.int64).reshape(len(records), -1),
        actions=np.array([record.actions for record in records], np.int64).reshape(len(records), -1),
        frames=sum(record.frames for record in records),
        seconds=loop.seconds,
        planned=loop.planned,
    )


def _solve(loop: _Loop, problems: Sequence[Problem]) -> None:
    """Solve one group of tasks, starting from the step that the journal has reached."""
    records = loop.journal.records(problems)
    loop.records.update(records)
    if all(len(record.actions) >= loop.settings.steps for record in records.values()):
        loop.on_progress()
        return
    worlds = [World(env, problem) for env, problem in zip(loop.envs, problems, strict=False)]
    memory = loop.journal.memory(problems)
    gaze = _Gaze(worlds, loop.actions, loop.envs[0].facts)
    for past in np.array([record.actions for record in records.values()], np.int64).T:
        _act(worlds, past)
        gaze.after(worlds, past)
    for record, world in zip(records.values(), worlds, strict=True):
        if not record.distance:
            record.note(world)
    for step in range(len(next(iter(records.values())).actions), loop.settings.steps):
        seen = gaze.seen(worlds, step, loop.settings.seed, memory)
        began = time.perf_counter()
        decision = _decide(loop.controller, seen, worlds)
        loop.seconds += time.perf_counter() - began
        loop.planned += len(worlds)
        loop.watch(Scene(seen=seen, decision=decision, worlds=worlds, distance=np.array([w.distance for w in worlds])))
        _act(worlds, decision.action)
        gaze.after(worlds, decision.action)
        memory = decision.plan.memory if decision.plan else None
        frames = decision.plan.frames if decision.plan else 0
        for place, (record, world) in enumerate(zip(records.values(), worlds, strict=True)):
            record.actions.append(int(decision.action[place]))
            record.frames += frames // len(worlds) + (place < frames % len(worlds))
            record.note(world)
        loop.journal.write(records, memory, last=step + 1 == loop.settings.steps)
        loop.on_progress()


def _decide(controller: Controller, seen: Seen, worlds: Sequence[World]) -> Decision:
    """Ask the controller for its actions; only references that declare it are given the simulator."""
    if isinstance(controller, KnowsSimulator):
        return controller.act_in(seen, worlds)
    return controller.act(seen)


def _act(worlds: Sequence[World], actions: Int[np.ndarray, " b"]) -> None:
    for world, action in zip(worlds, actions.tolist(), strict=True):
        if action != NO_ACTION:
            world.step(action)


class _Gaze:
    """The observations of a group of tasks, from images alone."""

    def __init__(self, worlds: Sequence[World], actions: int, spec: EnvSpec) -> None:
        self._current: UInt8[np.ndarray, "b h w 3"] = np.stack([world.frame for world in worlds])
        self._previous = self._current
        self._sights = Sights.first(torch.from_numpy(self._current))
        self._goals = np.stack([world.problem.goal_frame for world in worlds])
        self._blocked: Bool[np.ndarray, "b a"] = np.zeros((len(worlds), actions), np.bool_)
        self._tracker = Tracker(spec) if spec.objects else None
        if self._tracker is not None:
            images = (torch.from_numpy(frames) for frames in (self._current, self._goals))
            self._known, self._wanted = self._tracker.meet(*images)

    def after(self, worlds: Sequence[World], actions: Int[np.ndarray, " b"]) -> None:
        """Update the observations with the images after the actions."""
        frames = np.stack([world.frame for world in worlds])
        changed = (frames != self._current).any(axis=(1, 2, 3))
        self._blocked[changed] = False
        for place in np.flatnonzero(~changed & (actions != NO_ACTION)).tolist():
            self._blocked[place, actions[place]] = True
        still = ~changed[:, None, None, None]
        self._previous = np.where(still, self._previous, self._current)
        self._current = frames
        self._sights = self._sights.after(torch.from_numpy(actions), torch.from_numpy(frames))
        if self._tracker is not None:
            self._known = self._tracker.follow(self._known, torch.from_numpy(frames))

    def seen(self, worlds: Sequence[World], step: int, seed: int, memory: Int[np.ndarray, "b n t"] | None) -> Seen:
        """The observation that a controller is given."""
        return Seen(
            previous=self._previous,
            current=self._current,
            goals=self._goals,
            step=step,
            blocked=self._blocked.copy(),
            generators=tuple(task_generator(seed, world.problem, step) for world in worlds),
            memory=memory,
            tracked=None if self._tracker is None else (self._known, self._wanted),
            sights=self._sights,
        )


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
