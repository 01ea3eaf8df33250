"""Golden traces of control: the actions that are taken in a few stored tasks, and the distances that they reach.

Every solver and objective that published results were planned with works here on every environment, with a model that
needs no training (``PushingModel``, ``PerfectGridModel``), and so do the references. The solvers draw fewer sequences
than usual, to be fast; ``control.json`` also holds every field of those that are used for results.

Write the file anew with ``cd tests && python -m golden.control``, after raising CONTROL_VERSION.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from golden.pushing_model import PushingModel
from planning.worlds import PerfectGridModel

from dmotion_bench.environment import Environment
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import Agent, ModelAgent, make_reference
from dmotion_bench.planning.choices import (
    SIMULATOR,
    default_objective,
    make_objective,
    make_solver,
    planning_configuration,
)
from dmotion_bench.planning.mpc import CONTROL_VERSION, ControlSettings, control
from dmotion_bench.planning.objectives.base import Objective
from dmotion_bench.planning.objectives.true_cost import TrueCost
from dmotion_bench.planning.solvers.base import Solver
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.planning.solvers.exhaustive import Exhaustive
from dmotion_bench.planning.tasks import Problem
from dmotion_bench.recording.rollout import policy_generator
from dmotion_bench.specs import ObjectStates
from dmotion_bench.storage.tasks import ControlTask
from recorders.grid_world import GridWorld
from recorders.planar_push import PlanarPush
from recorders.planar_push.environment import TABLE_COLOR as PLANAR_TABLE
from recorders.robot_push import RobotPush
from recorders.robot_push.scene import TABLE_COLOR as ROBOT_TABLE

FILE: Final = Path(__file__).with_name("control.json")
ADVICE: Final = (
    "If this is meant, raise CONTROL_VERSION in dmotion_bench/planning/mpc.py and write the traces anew with "
    "'cd tests && python -m golden.control'; published results of the version before are then of another version."
)
STEPS: Final = 6
OPENING: Final = 12
GOAL: Final = 12
"""Actions before a task's start, and between its start and its goal."""
FIRST_SEED: Final = 5
"""From here on no action hangs by a millionth of a cost [tried], which another processor may round otherwise."""


@dataclass(frozen=True, kw_only=True)
class World:
    """An environment of the traces, and a model of it."""

    make_env: Callable[[], Environment]
    make_model: Callable[[Environment], ForwardModel[Any]]


@dataclass(frozen=True, kw_only=True)
class Case:
    """Who acts: a model, or a reference by its name; with a planner and a cost if it plans."""

    environment: str
    who: str
    planner: str = "icem"
    cost: str | None = None

    @property
    def name(self) -> str:
        """Its name in the file."""
        plans = [self.planner, self.cost or "default cost"] if self.who in ("model", "oracle") else []
        return ", ".join([self.environment, self.who, *plans])


def _robot_model(env: Environment) -> PushingModel:
    red, green, blue = (round(255 * channel) for channel in ROBOT_TABLE)
    return PushingModel(env.facts, (red, green, blue))


WORLDS: Final = {
    "grid_world": World(make_env=GridWorld, make_model=lambda _: PerfectGridModel()),
    "planar_push": World(make_env=PlanarPush, make_model=lambda env: PushingModel(env.facts, PLANAR_TABLE)),
    "robot_push": World(make_env=RobotPush, make_model=_robot_model),
}
SOLVERS: Final = ("cem", "exhaustive", "icem")
OBJECTIVES: Final = ("centres", "feature", "pixel", "tabletop", "tracked")
"""Those that results were made with."""

FINDS: Final = {"grid_world": (), "planar_push": ("followed",), "robot_push": ("tracked",)}
"""Costs of objects that are not the environment's default."""
CASES: Final = tuple(
    case
    for environment in WORLDS
    for case in (
        Case(environment=environment, who="model"),
        Case(environment=environment, who="model", planner="cem", cost="position"),
        *(Case(environment=environment, who="model", planner="cem", cost=cost) for cost in FINDS[environment]),
        Case(environment=environment, who="model", cost="pixel"),
        Case(environment=environment, who="model", cost="feature"),
        Case(environment=environment, who="model", planner="exhaustive"),
        Case(environment=environment, who="oracle"),
        Case(environment=environment, who="oracle", planner="cem", cost="position"),
        Case(environment=environment, who="scripted"),
        Case(environment=environment, who="random"),
    )
)


def small(name: str) -> Solver:
    """A solver that draws few sequences; what is left of its fields is as usual."""
    solver = make_solver(name)
    if isinstance(solver, CrossEntropy):
        return replace(solver, samples=10, iterations=3, elites=4)
    assert isinstance(solver, Exhaustive)
    return replace(solver, horizon=3)


def agent(case: Case, solver: Solver, objective: Objective | None = None) -> Agent:
    """Whoever acts in a case, with another objective than the case's if one is given."""
    world = WORLDS[case.environment]
    env = world.make_env()
    try:
        if objective is None and case.cost is not None:
            objective = make_objective(case.cost)
        if case.who != "model":
            return make_reference(case.who, env.facts, world.make_env, solver, objective)
        objective = objective or make_objective(default_objective(case.environment, env.facts, needs_pixels=True))
        return ModelAgent(world.make_model(env), env.facts, solver, objective, bf16=False)
    finally:
        env.close()


def trace(
    case: Case, tasks: list[dict[str, Any]], solver: Solver | None = None, objective: Objective | None = None
) -> dict[str, Any]:
    """What a case does in some tasks."""
    make_env = WORLDS[case.environment].make_env
    result = control(
        agent(case, solver or small(case.planner), objective),
        _problems(case.environment, json.dumps(tasks)),
        make_env,
        ControlSettings(steps=STEPS, group=2),
    )
    return {
        "actions": [" ".join(map(str, own)) for own in result.actions.tolist()],
        "distance": [[float(f"{one:.9g}") for one in own] for own in result.distance.tolist()],
        "lost": result.lost.tolist(),
    }


@functools.cache
def _problems(environment: str, tasks: str) -> list[Problem]:
    """Those of tasks in JSON, made once for all cases: drawing them takes as long as many a case."""
    return problems(WORLDS[environment].make_env, json.loads(tasks))


def problems(make_env: Callable[[], Environment], tasks: list[dict[str, Any]]) -> list[Problem]:
    """Tasks as control takes them, each with the pictures and places that its actions lead to."""
    env, found = make_env(), []
    for number, task in enumerate(tasks):
        opening, goal = task["opening"], task["goal"]
        frame = env.reset(seed=task["seed"])[0]
        for action in opening:
            frame = env.step(action)[0]
        start_frame, start_objects = frame.copy(), _objects(env)
        for action in goal:
            frame = env.step(action)[0]
        found.append(
            Problem(
                number=number,
                task=ControlTask(episode=number, start=len(opening), goal=len(opening) + len(goal)),
                seed=task["seed"],
                vary=(),
                opening=np.array(opening),
                start_frame=start_frame,
                goal_frame=frame.copy(),
                start_objects=start_objects,
                goal_objects=_objects(env),
            )
        )
    env.close()
    return found


def _objects(env: Environment) -> ObjectStates:
    states = env.objects()
    return ObjectStates(**{one.name: getattr(states, one.name).copy() for one in fields(states)})


def configurations() -> dict[str, Any]:
    """Every field of the solvers and the objectives that results are made with."""
    facts = {name: world.make_env().facts for name, world in WORLDS.items()}
    cem, centres = make_solver("cem"), make_objective("centres")
    return {
        "solvers": {
            name: planning_configuration(name, make_solver(name), "centres", centres)["solver"] for name in SOLVERS
        },
        "objectives": {
            name: planning_configuration("cem", cem, name, make_objective(name))["objective"] for name in OBJECTIVES
        }
        | {SIMULATOR: planning_configuration("cem", cem, SIMULATOR, TrueCost())["objective"]},
        "default objectives": {
            f"{name}, {'pixels' if pixels else 'features'}": default_objective(name, one, needs_pixels=pixels)
            for name, one in facts.items()
            for pixels in (True, False)
        },
    }


def stored() -> dict[str, Any]:
    """The golden file."""
    content: dict[str, Any] = json.loads(FILE.read_text())
    return content


def choose_tasks(environment: str, count: int = 2) -> list[dict[str, Any]]:
    """The first tasks in which something is to be done: several steps to the goal move an object, and none is lost."""
    env = WORLDS[environment].make_env()
    kind = type(env)
    tasks: list[dict[str, Any]] = []
    seed = FIRST_SEED
    while len(tasks) < count:
        actions, places = _episode(env, kind.policies[kind.default_policy](), seed)
        if len(actions) == OPENING + GOAL and not np.isnan(places[-1] - places[OPENING]).any():
            steps = np.abs(np.diff(places[OPENING:], axis=0)).max(axis=(1, 2)) > env.facts.push_threshold
            if steps.sum() >= 3:
                tasks.append({"seed": seed, "opening": actions[:OPENING], "goal": actions[OPENING:]})
        seed += 1
    env.close()
    return tasks


def _episode(env: Environment, policy: Any, seed: int) -> tuple[list[int], Any]:
    env.reset(seed=seed)
    generator = policy_generator(seed)
    actions, places = list[int](), [env.objects().position.copy()]
    for _ in range(OPENING + GOAL):
        actions.append(int(policy(env, generator)))
        ended = env.step(actions[-1])[2]
        places.append(env.objects().position.copy())
        if ended:
            break
    return actions, np.array(places)


def main() -> None:
    """Write the golden file; the tasks stay as they are once they are there."""
    known = stored() if FILE.is_file() else {}
    tasks = known.get("tasks") or {name: choose_tasks(name) for name in WORLDS}
    torch.set_num_threads(1)
    content = {
        "control_version": CONTROL_VERSION,
        "configurations": configurations(),
        "earlier configurations": known.get("earlier configurations", {}),
        "tasks": tasks,
        "traces": {case.name: trace(case, tasks[case.environment]) for case in CASES},
    }
    FILE.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
