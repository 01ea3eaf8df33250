"""Who chooses the actions.

A model with a planner is given images: the last two, and the goal. The references beside it: ``idle`` does nothing
(1.000 by definition), ``random`` any action, ``oracle`` plans with the simulator in the model's place, ``scripted``
(``pusher.py``) pushes by rules. Only those two are handed the simulator, through another door (``act_in``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8

from dmotion_bench.actions import require_discrete
from dmotion_bench.environment import Environment
from dmotion_bench.errors import InvalidSetting, ModelContractBroken, UnknownName
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.costs import PositionCost, TrackedCost, make_cost
from dmotion_bench.planning.exploring import Sights
from dmotion_bench.planning.futures import ModelFutures
from dmotion_bench.planning.planner import DEFAULT_PLANNER, Moment, Plan, Planner, make_planner
from dmotion_bench.planning.problems import Problem, World
from dmotion_bench.planning.simulation import Simulation, SimulatorFutures
from dmotion_bench.planning.tracking import Outlines, Tracker
from dmotion_bench.specs import EnvSpec

NO_ACTION = -1
REFERENCES = ("idle", "random", "oracle", "scripted")


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The observation of some tasks at one control step: images, and the controller's own past actions.

    Attributes:
        previous, current: The last two images; at the start the first one twice. A step that changed nothing in the
            picture is not counted.
        goals: What it should look like.
        step: How many actions were taken before.
        blocked: Actions that left the picture as it is, since it last changed.
        generators: See ``Moment``.
        memory: See ``Moment``.
        tracked: Where the objects are, by all that was seen, and where they should be; None where there are none.
        sights: All that was seen, and what was done there; None for a controller that is asked out of the blue.
    """

    previous: UInt8[np.ndarray, "b h w 3"]
    current: UInt8[np.ndarray, "b h w 3"]
    goals: UInt8[np.ndarray, "b h w 3"]
    step: int
    blocked: Bool[np.ndarray, "b a"]
    generators: tuple[np.random.Generator, ...]
    memory: Int[np.ndarray, "b n t"] | None = None
    tracked: tuple[Outlines, Outlines] | None = None
    sights: Sights | None = None

    @property
    def moment(self) -> Moment:
        """The part of the observation that a planner is given."""
        return Moment(generators=self.generators, blocked=self.blocked, memory=self.memory)


@dataclass(frozen=True, kw_only=True)
class Decision:
    """The actions to take (``NO_ACTION`` for none), and the plan that led to them, if any."""

    action: Int[np.ndarray, " b"]
    plan: Plan | None = None


@runtime_checkable
class Controller(Protocol):
    """Chooses an action for each of some tasks from what is seen of them."""

    def act(self, seen: Seen) -> Decision:
        """The next actions."""


@runtime_checkable
class KnowsSimulator(Protocol):
    """A reference that may read the simulator's state."""

    def act_in(self, seen: Seen, worlds: Sequence[World]) -> Decision:
        """The next actions."""


class ModelController:
    """A forward model and a planner.

    Args:
        model: Aligned; put into evaluation mode.
        spec: What the objects look like.
        planner: Searches what the model imagines.
        cost: Of ``costs.COSTS``; None for what suits the model.
        bf16: See ``ModelFutures``.
        device: Where the model runs.

    Raises:
        ModelContractBroken: The model knows other actions than the environment.
    """

    def __init__(
        self,
        model: ForwardModel[Any],
        spec: EnvSpec,
        planner: Planner,
        *,
        cost: str | None = None,
        bf16: bool | None = None,
        device: torch.device | None = None,
    ) -> None:
        own, known = (require_discrete(actions, "planning") for actions in (model.inputs.actions, spec.actions))
        if not known.fits(own):
            raise ModelContractBroken(
                f"the model was made for {len(own)} actions, and {spec.id!r} has {len(known)}; "
                "plan on the data set that it was trained on."
            )
        self.device = device or torch.device("cpu")
        self.model = model.to(self.device).eval()
        self.spec, self.planner, self.cost, self.bf16 = spec, planner, cost, bf16

    def futures(self, seen: Seen) -> ModelFutures:
        """The model's predictions from the present observation."""
        previous, current, goals = (
            torch.from_numpy(images).to(self.device) for images in (seen.previous, seen.current, seen.goals)
        )
        tracked = None if seen.tracked is None else (seen.tracked[0].to(self.device), seen.tracked[1].to(self.device))
        with torch.inference_mode():
            cost = make_cost(self.cost, self.model, self.spec, current, goals, tracked, seen.sights)
        return ModelFutures(self.model, cost, previous, current, bf16=self.bf16)

    def act(self, seen: Seen) -> Decision:
        """The first action of the best plan."""
        plan = self.planner.plan(self.futures(seen), seen.moment)
        return Decision(action=plan.action, plan=plan)


class IdleController:
    """Does nothing."""

    def act(self, seen: Seen) -> Decision:
        """No action."""
        return Decision(action=np.full(len(seen.current), NO_ACTION))


class RandomController:
    """Takes actions at random, all with the same probability."""

    def act(self, seen: Seen) -> Decision:
        """Draw one action for each task from the task's own generator."""
        return Decision(action=np.array([generator.integers(seen.blocked.shape[1]) for generator in seen.generators]))


class OracleController:
    """Plans with the true simulator in the model's place: an upper bound for models.

    Args:
        spec: What the objects look like.
        planner: Searches the simulator's futures.
        make_env: Makes simulators to try things out in.
        cost: None for the simulator's own positions; "tracked" and "position" find them in its pictures.
    """

    def __init__(
        self, spec: EnvSpec, planner: Planner, make_env: Callable[[], Environment], cost: str | None = None
    ) -> None:
        if not spec.objects or cost not in (None, "position", "tracked"):
            raise InvalidSetting(f"the oracle plans with objects' positions; it cannot use the cost {cost!r} here.")
        self._spec, self._planner, self._make_env, self._cost = spec, planner, make_env, cost
        self._tracker = Tracker(spec)
        self._simulations: dict[int, Simulation] = {}

    def act(self, seen: Seen) -> Decision:
        """Raises TypeError: the oracle needs the simulator, see ``act_in``."""
        raise TypeError("the oracle needs the simulator")

    def act_in(self, seen: Seen, worlds: Sequence[World]) -> Decision:
        """The first action of the best plan."""
        simulations = [self._simulation(place, world, seen) for place, world in enumerate(worlds)]
        plan = self._planner.plan(SimulatorFutures(simulations, seen.blocked.shape[1]), seen.moment)
        return Decision(action=plan.action, plan=plan)

    def _simulation(self, place: int, world: World, seen: Seen) -> Simulation:
        """The second simulator of the task at one place of the group, set to the task's present state."""
        known = self._simulations.get(place)
        if known is None or known.problem is not world.problem:
            env = known.env if known else self._make_env()
            known = self._simulations[place] = Simulation(env, world.problem, self._look)
        known.price = self._price(place, world.problem, seen)
        known.follow(world)
        return known

    def _price(self, place: int, problem: Problem, seen: Seen) -> Callable[[Any], float]:
        if self._cost is None:
            return problem.squared_distance
        cost: PositionCost | TrackedCost
        if self._cost == "position":
            cost = PositionCost(self._spec, torch.from_numpy(seen.goals[place])[None])
        else:
            assert seen.tracked is not None, "there are objects"
            here = torch.tensor([place])
            cost = TrackedCost(self._spec, seen.tracked[0].of(here), seen.tracked[1].of(here))
        return lambda look: float(cost.of_looks(look, torch.zeros(1, dtype=torch.long)))

    def _look(self, frame: UInt8[np.ndarray, "h w 3"], env: Environment) -> Any:
        if self._cost is None:
            return env.objects().position.copy()
        return self._tracker.look(torch.from_numpy(frame)[None])


def make_reference(
    name: str,
    spec: EnvSpec,
    make_env: Callable[[], Environment],
    planner: Planner | None = None,
    cost: str | None = None,
) -> Controller:
    """A reference by its name.

    Raises:
        UnknownName: There is none of this name.
    """
    from dmotion_bench.planning.pusher import ScriptedPusher

    if name == "oracle":
        return OracleController(spec, planner or make_planner(DEFAULT_PLANNER), make_env, cost)
    simple: dict[str, Callable[[], Controller]] = {
        "idle": IdleController,
        "random": RandomController,
        "scripted": ScriptedPusher,
    }
    if name not in simple:
        raise UnknownName("reference", name, REFERENCES)
    return simple[name]()
