"""Who chooses the actions.

A model with a solver is given images: the last two, and the goal. The references beside it: ``idle`` does nothing
(1.000 by definition), ``random`` takes any action, ``oracle`` plans with the simulator in the model's place,
``scripted`` goes by rules that the environment brings. Only the last two are handed the simulator.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.environment import Environment, HasScript, Script
from dmotion_bench.errors import InvalidSetting, ModelContractBroken, UnknownName
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.dynamics.simulator import Simulation, SimulatorDynamics
from dmotion_bench.planning.objectives.base import Evaluator, Objective, Taken
from dmotion_bench.planning.objectives.checked import checked_reset
from dmotion_bench.planning.objectives.true_cost import TrueCost
from dmotion_bench.planning.solvers.base import LooksAtFrames, Plan, PlanContext, Solver
from dmotion_bench.planning.solvers.checked import checked_plan
from dmotion_bench.planning.tasks import World
from dmotion_bench.specs import EnvSpec

NO_ACTION = -1
REFERENCES = ("idle", "random", "oracle", "scripted")


@dataclass(frozen=True, kw_only=True)
class Decision:
    """The actions to take (``NO_ACTION`` or NaN for none), and the plan that led to them, if any."""

    action: Taken
    plan: Plan | None = None


class Agent(ABC):
    """Chooses an action for each of some tasks from what is seen of them."""

    def reset(  # noqa: B027 -- an agent without a memory has nothing to do
        self, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
    ) -> None:
        """Some tasks begin.

        Args:
            first, goals: What is seen at their start, and what should be seen.
        """

    def observe(  # noqa: B027 -- likewise
        self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]
    ) -> None:
        """What was really done, by whomever, and what is seen after it."""

    def close(self) -> None:  # noqa: B027 -- likewise
        """All tasks are done: whatever the agent holds open is closed."""

    @abstractmethod
    def act(self, context: PlanContext) -> Decision:
        """The next actions."""


class SimulatorAgent(Agent):
    """A reference that may read the simulator's state."""

    def watch(self, worlds: Sequence[World]) -> None:
        """Called with the tasks' simulators at their start and after every step."""

    def act(self, context: PlanContext) -> Decision:
        """Raises TypeError: it needs the simulator, see ``act_in``."""
        raise TypeError(f"{type(self).__name__} needs the simulator")

    @abstractmethod
    def act_in(self, context: PlanContext, worlds: Sequence[World]) -> Decision:
        """The next actions."""


class PlanningAgent(Agent):
    """A solver and an objective; those who inherit from it say in which dynamics they plan.

    Args:
        spec: Of the environment.
        solver: Searches for actions.
        objective: What it minimises.
    """

    def __init__(self, spec: EnvSpec, solver: Solver, objective: Objective) -> None:
        self._spec, self._solver, self._objective = spec, solver, objective
        self._evaluator: Evaluator | None = None

    def reset(self, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]) -> None:
        """The objective begins anew."""
        self._evaluator = checked_reset(self._objective, self._spec, first, goals)

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """The objective may remember it."""
        assert self._evaluator is not None, "reset comes first"
        self._evaluator.observe(actions, frames)

    def plan(self, dynamics: Dynamics, context: PlanContext) -> Decision:
        """The first action of the best plan, in the units of the environment.

        Raises:
            PlannerContractBroken: As ``checked_plan``.
        """
        assert self._evaluator is not None, "reset comes first"
        plan = checked_plan(self._solver, dynamics, self._evaluator, context)
        spec = dynamics.actions
        action: Any = plan.action
        return Decision(action=spec.denormalise(action) if isinstance(spec, Continuous) else action, plan=plan)


class ModelAgent(PlanningAgent):
    """A forward model, an objective and a solver.

    Args:
        model: Aligned; put into evaluation mode.
        spec: Of the environment.
        solver: Searches what the model predicts.
        objective: What it minimises.
        bf16: See ``ModelDynamics``.
        device: Where the model runs.

    Raises:
        ModelContractBroken: The model knows other actions than the environment.
    """

    def __init__(
        self,
        model: ForwardModel[Any],
        spec: EnvSpec,
        solver: Solver,
        objective: Objective,
        *,
        bf16: bool | None = None,
        device: torch.device | None = None,
    ) -> None:
        super().__init__(spec, solver, objective)
        own = model.inputs.actions
        if spec.actions is None or own is None or not own.fits(spec.actions):
            raise ModelContractBroken(
                f"the model was made for {_counted(own)}, and {spec.id!r} has {_counted(spec.actions)}; "
                "plan on the data set that it was trained on."
            )
        device = device or torch.device("cpu")
        self.dynamics = ModelDynamics(model.to(device).eval(), bf16=bf16, device=device)

    def act(self, context: PlanContext) -> Decision:
        """The first action of the best plan."""
        return self.plan(self.dynamics, context)


def known_actions(spec: EnvSpec) -> ActionSpec:
    """What can be done in an environment.

    Raises:
        InvalidSetting: That is not known, as in recordings that were imported without actions.
    """
    if spec.actions is None:
        raise InvalidSetting(f"the actions of {spec.id!r} are not known, so nothing can be planned with them.")
    return spec.actions


def was_taken(actions: Taken) -> Bool[np.ndarray, " b"]:
    """Which rows of actions are some, and not ``NO_ACTION`` or NaN."""
    return np.asarray(actions != NO_ACTION if actions.ndim == 1 else ~np.isnan(actions).any(axis=1))


def no_action(spec: ActionSpec, count: int) -> Taken:
    """Rows in which nothing is done."""
    return np.full(count, NO_ACTION) if isinstance(spec, Discrete) else np.full((count, spec.width), np.nan)


def _counted(actions: ActionSpec | None) -> str:
    """Actions, as a sentence speaks of them."""
    if actions is None:
        return "actions that are not known"
    return f"{len(actions)} actions" if isinstance(actions, Discrete) else f"the continuous action {actions}"


class IdleAgent(Agent):
    """Does nothing.

    Args:
        actions: What could be done.
    """

    def __init__(self, actions: ActionSpec) -> None:
        self._actions = actions

    def act(self, context: PlanContext) -> Decision:
        """No action."""
        return Decision(action=no_action(self._actions, len(context.generators)))


class RandomAgent(Agent):
    """Takes actions at random, all with the same probability.

    Args:
        actions: What can be done.
    """

    def __init__(self, actions: ActionSpec) -> None:
        self._actions = actions

    def act(self, context: PlanContext) -> Decision:
        """Draw one action for each task from the task's own generator."""
        spec, generators = self._actions, context.generators
        if isinstance(spec, Discrete):
            return Decision(action=np.array([generator.integers(len(spec)) for generator in generators]))
        drawn = np.stack([generator.uniform(-1, 1, spec.width) for generator in generators])
        return Decision(action=spec.denormalise(drawn))


class OracleAgent(PlanningAgent, SimulatorAgent):
    """Plans with the true simulator in the model's place: an upper bound for models.

    Args:
        spec: Of the environment.
        solver: Searches what the simulator says.
        make_env: Makes simulators to try things out in.
        objective: None for ``TrueCost``; others look at the simulator's pictures.
    """

    def __init__(
        self, spec: EnvSpec, solver: Solver, make_env: Callable[[], Environment], objective: Objective | None = None
    ) -> None:
        super().__init__(spec, solver, objective or TrueCost())
        self._make_env = make_env
        looks = isinstance(solver, LooksAtFrames) and solver.looks_at_frames
        self._by_images = looks or not isinstance(self._objective, TrueCost)
        self._simulations: dict[int, Simulation] = {}

    def close(self) -> None:
        """Close the simulators; the next task makes new ones."""
        for simulation in self._simulations.values():
            simulation.env.close()
        self._simulations.clear()

    def act_in(self, context: PlanContext, worlds: Sequence[World]) -> Decision:
        """The first action of the best plan."""
        simulations = [self._simulation(place, world) for place, world in enumerate(worlds)]
        return self.plan(SimulatorDynamics(simulations, known_actions(self._spec)), context)

    def _simulation(self, place: int, world: World) -> Simulation:
        """The second simulator of the task at one place of the group, set to the task's present state."""
        known = self._simulations.get(place)
        if known is None or known.problem is not world.problem:
            env = known.env if known else self._make_env()
            known = Simulation(env, world.problem, pictures=self._by_images)
            self._simulations[place] = known
        known.follow(world)
        return known


class ScriptedAgent(SimulatorAgent):
    """Follows the environment's own script."""

    def __init__(self) -> None:
        self._scripts: list[tuple[World, Script]] = []

    def watch(self, worlds: Sequence[World]) -> None:
        """Let the scripts see every state; each task has a script of its own.

        Raises:
            InvalidSetting: The environment comes with no script.
        """
        if [world for world, _ in self._scripts] != list(worlds):
            self._scripts = [(world, _script(world.env)) for world in worlds]
        for world, script in self._scripts:
            script.watch(world.env)

    def act_in(self, context: PlanContext, worlds: Sequence[World]) -> Decision:
        """The next step of each task's script."""
        action = no_action(known_actions(worlds[0].env.facts), len(worlds))
        for place, (world, script) in enumerate(self._scripts):
            chosen = script.act(world.env, world.problem.goal_objects)
            if chosen is not None:
                action[place] = chosen
        return Decision(action=action)


def _script(env: Environment) -> Script:
    if not isinstance(env, HasScript):
        raise InvalidSetting(f"{env.facts.id!r} comes with no scripted reference; use 'random' or 'oracle'.")
    return env.script()


def make_reference(
    name: str,
    spec: EnvSpec,
    make_env: Callable[[], Environment],
    solver: Solver,
    objective: Objective | None = None,
) -> Agent:
    """A reference by its name.

    Args:
        name: Of ``REFERENCES``.
        spec, make_env: Of the environment.
        solver, objective: Of the oracle; the others ignore them.

    Raises:
        UnknownName: There is none of this name.
    """
    made: dict[str, Callable[[], Agent]] = {
        "idle": lambda: IdleAgent(known_actions(spec)),
        "random": lambda: RandomAgent(known_actions(spec)),
        "oracle": lambda: OracleAgent(spec, solver, make_env, objective),
        "scripted": ScriptedAgent,
    }
    if name not in made:
        raise UnknownName("reference", name, REFERENCES)
    return made[name]()
