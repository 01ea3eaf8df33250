"""Predictions by the true simulator, which a perfect model would make. Only the oracle uses them.

A state is what leads to it, a seed and actions, so any state can be had by replay. Environments that are
``Restorable`` are put back instead, which is much faster. Everything happens in a simulator of its own, so that the
one that is being controlled never feels it.

What has been tried is remembered: where a step moves nothing but the agent, different sequences lead to the very
same places, and most of a plan's futures were known at the step before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.environment import Environment, Restorable
from dmotion_bench.planning.futures import States
from dmotion_bench.planning.problems import Problem, World, start

Look = Callable[[UInt8[np.ndarray, "h w 3"], Environment], Any]
"""What of a picture, or of the simulator that shows it, its cost is made of; it is kept as long as the task lasts."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """A state that the simulator has reached.

    Attributes:
        actions: What leads there from the problem's start.
        snapshot: Of the environment, where it can be restored.
        name: Where everything is, bit by bit: places of the same name are the same.
        look: Of what is there.
    """

    actions: tuple[int, ...]
    snapshot: Any
    name: bytes
    look: Any


class Simulation:
    """A second simulator, in which the actions for one problem are tried out.

    Args:
        env: For this problem alone, as long as the problem lasts.
        problem: Whose start it is brought to.
        look: Looks at a picture and at what is behind it.

    Attributes:
        here: Where the problem's world is.
        price: The cost of a look, at the present step.
        tried: How many steps were simulated.
    """

    price: Callable[[Any], float]

    def __init__(self, env: Environment, problem: Problem, look: Look) -> None:
        self.env, self.problem, self.tried = env, problem, 0
        self._look = look
        self._after: dict[tuple[bytes, int], Place] = {}
        frame = start(env, problem)
        self.here = self._now = _place(env, (), look(frame, env))

    def follow(self, world: World) -> None:
        """Move to the present state of the controlled simulator."""
        actions = tuple(world.actions)
        if actions == self.here.actions:
            return
        if isinstance(self.env, Restorable):  # a restored state may differ from the true one in its last bits
            self.here = _place(world.env, actions, None)
        else:
            for action in actions[len(self.here.actions) :]:
                self.here = self.step(self.here, action)

    def step(self, place: Place, action: int) -> Place:
        """The state that an action leads to."""
        known = self._after.get((place.name, action))
        if known is None:
            self._go(place)
            frame = self.env.step(action)[0]
            self.tried += 1
            known = self._now = _place(self.env, (*place.actions, action), self._look(frame, self.env))
            self._after[place.name, action] = known
        if known.actions[:-1] != place.actions:  # the same place, reached on another way
            known = Place(actions=(*place.actions, action), snapshot=known.snapshot, name=known.name, look=known.look)
        return known

    def _go(self, place: Place) -> None:
        if self._now.name == place.name:
            return
        if isinstance(self.env, Restorable):
            self.env.restore(place.snapshot)
        else:
            start(self.env, self.problem, place.actions)


def _place(env: Environment, actions: tuple[int, ...], look: Any) -> Place:
    agent, objects = env.agent(), env.objects()
    parts = (agent.position, objects.position, objects.orientation)
    return Place(
        actions=actions,
        snapshot=env.snapshot() if isinstance(env, Restorable) else None,
        name=b"".join(np.ascontiguousarray(part).tobytes() for part in parts),
        look=look,
    )


class SimulatorFutures:
    """The simulator's true outcomes, with the interface of a model's predictions.

    Args:
        simulations: One per task, each where its task stands.
        actions: How many there are.
    """

    at_once = 64

    def __init__(self, simulations: Sequence[Simulation], actions: int) -> None:
        self._simulations = simulations
        self.tasks, self.actions = len(simulations), actions
        self._places = [simulation.here for simulation in simulations]

    def begin(self) -> States:
        """The number of each task's present place in the list of places."""
        return (torch.arange(self.tasks),)

    def expand(
        self, states: States, task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[States, Float[Tensor, " n"]]:
        """The states that the actions truly lead to, and their costs."""
        first, costs = len(self._places), list[float]()
        for number, of_task, taken in zip(states[0].tolist(), task.tolist(), action.tolist(), strict=True):
            simulation = self._simulations[of_task]
            self._places.append(simulation.step(self._places[number], taken))
            costs.append(simulation.price(self._places[-1].look))
        return (torch.arange(first, len(self._places)),), torch.tensor(costs, dtype=torch.float32)
