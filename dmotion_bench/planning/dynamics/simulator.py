"""The true simulator as the dynamics, which a perfect model would be. Only the oracle uses it.

A state is what leads to it, a seed and actions, so any state can be had by replay. Environments that are
``Restorable`` are put back instead, which is much faster. Everything happens in a simulator of its own, so that the
one that is being controlled never feels it.

What has been tried is remembered. In an environment that is ``Settled`` a step often moves nothing but the agent, so
different sequences lead to the very same places, and most of what a plan looks at was known at the step before.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec, ActionTaken, Continuous, as_actions, given
from dmotion_bench.environment import Environment, ObjectEnvironment, Remembering, Restorable, Settled, Undrawn
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.images import to_model
from dmotion_bench.planning.dynamics.base import Actions, Observation, State
from dmotion_bench.planning.tasks import Problem, World, asking, judged_distance, measure_of, start, take


@dataclass(frozen=True, kw_only=True)
class Place:
    """A state that the simulator has reached.

    Attributes:
        actions: What leads there from the problem's start.
        snapshot: Of the environment, where it can be restored.
        name: What decides all that follows, bit by bit: places of the same name are the same. Where everything is and
            how it is turned; unless the environment says that this is all (``Settled``), what was done since the start,
            too: the same poses may hide different velocities.
        cost: Its true cost; NaN where it was not asked for.
        distance: Its judged distance from the goal, likewise.
        picture: What is seen there, compressed; None where it was not asked for.
    """

    actions: tuple[ActionTaken, ...]
    snapshot: Any
    name: bytes
    cost: float
    distance: float
    picture: bytes | None


class Simulation:
    """A second simulator, in which the actions for one problem are tried out.

    Args:
        env: For this problem alone, as long as the problem lasts.
        problem: Whose start it is brought to.
        pictures: Whether what is seen is kept.

    Attributes:
        here: Where the problem's world is.
        tried: How many steps were simulated.
    """

    def __init__(self, env: Environment, problem: Problem, *, pictures: bool = False) -> None:
        self.env, self.problem, self.tried = env, problem, 0
        self._measure, self._pictures = measure_of(env, problem), pictures
        # asked once, because isinstance with a protocol is slow
        self._tells_objects, self._remembers = isinstance(env, ObjectEnvironment), isinstance(env, Remembering)
        self._restorable = env if isinstance(env, Restorable) else None
        self._settled = isinstance(env, Settled) and env.settled
        self._undrawn = env if isinstance(env, Undrawn) and not pictures else None
        self._after: dict[tuple[bytes, ActionTaken], Place] = {}
        with asking(env, problem):
            self.here = self._now = self._place((), start(env, problem))

    def follow(self, world: World) -> None:
        """Move to the present state of the controlled simulator."""
        actions = tuple(world.actions)
        if actions == self.here.actions:
            return
        if self._restorable is not None:  # a restored state may differ from the true one in its last bits
            with asking(world.env, self.problem):
                self.here = self._seen_from(world.env, actions)
        else:
            for action in actions[len(self.here.actions) :]:
                self.here = self.step(self.here, action)
        if isinstance(self.env.facts.actions, Continuous):
            self._after.clear()  # hardly any of it will be met again

    def step(self, place: Place, action: ActionTaken) -> Place:
        """The state that an action leads to."""
        known = self._after.get((place.name, action))
        if known is None:
            with asking(self.env, self.problem):
                known = self._now = self._tried(place, action)
            self._after[place.name, action] = known
        if known.actions[:-1] != place.actions:  # the same place, reached on another way
            known = replace(known, actions=(*place.actions, action))
        return known

    def _tried(self, place: Place, action: ActionTaken) -> Place:
        """What the simulator comes to from a place."""
        self._go(place)
        frame = None
        if self._undrawn is None:
            frame = take(self.env, action)
        else:
            self._undrawn.advance(given(action))
        self.tried += 1
        return self._place((*place.actions, action), frame)

    def picture(self, place: Place) -> UInt8[np.ndarray, "h w 3"]:
        """What is seen at a place."""
        if place.picture is None:
            raise InvalidSetting("this simulation keeps no pictures.")
        spec = self.env.facts
        return np.frombuffer(zlib.decompress(place.picture), np.uint8).reshape(spec.height, spec.width, 3)

    def _go(self, place: Place) -> None:
        if self._now.name == place.name:
            return
        if self._restorable is not None:
            self._restorable.restore(place.snapshot)
        else:
            start(self.env, self.problem, place.actions)

    def _place(self, actions: tuple[ActionTaken, ...], frame: UInt8[np.ndarray, "h w 3"] | None) -> Place:
        picture = None
        if self._pictures and frame is not None:
            picture = zlib.compress(np.ascontiguousarray(frame).tobytes(), 1)
        cost, distance = self._measure.cost(self.env), judged_distance(self._measure, self.env, self.problem)
        return replace(self._seen_from(self.env, actions), cost=cost, distance=distance, picture=picture)

    def _seen_from(self, env: Environment, actions: tuple[ActionTaken, ...]) -> Place:
        parts: list[np.ndarray] = []
        if self._tells_objects:
            telling = cast(ObjectEnvironment, env)
            agent, objects = telling.agent(), telling.objects()
            parts += (agent.position, agent.orientation, objects.position, objects.orientation)
        if not self._settled or not parts:
            parts.append(np.array(actions))
        name = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
        if self._pictures and self._remembers:  # what moves by itself makes other pictures of a place
            name += cast(Remembering, env).memory()
        return Place(
            actions=actions,
            snapshot=None if self._restorable is None else cast(Restorable, env).snapshot(),
            name=name,
            cost=float("nan"),
            distance=float("nan"),
            picture=None,
        )


class SimulatorDynamics:
    """The simulator's true outcomes; a state is the number of its task and of its place.

    Args:
        simulations: One per task, each where its task stands.
        actions: What can be done.
    """

    at_once = 64
    device = torch.device("cpu")

    def __init__(self, simulations: Sequence[Simulation], actions: ActionSpec) -> None:
        self._simulations, self.actions = simulations, actions
        self._places = [simulation.here for simulation in simulations]

    @contextlib.contextmanager
    def computing(self, *, gradients: bool = False) -> Iterator[None]:
        """Without gradients: a simulator has none."""
        if gradients:
            raise InvalidSetting("the true simulator has no gradients; plan with 'cem', 'icem' or 'mppi'.")
        with torch.inference_mode():
            yield

    def start(self, observation: Observation) -> State:
        """Where each task's simulation is."""
        tasks = torch.arange(len(self._simulations))
        return tasks, tasks

    def step(self, state: State, action: Actions) -> State:
        """The states that the actions truly lead to."""
        task, number = state
        first, spec = len(self._places), self.actions
        given = spec.denormalise(action.double().numpy()) if isinstance(spec, Continuous) else action.numpy()
        for own, place, taken in zip(task.tolist(), number.tolist(), as_actions(given), strict=True):
            self._places.append(self._simulations[own].step(self._places[place], taken))
        return task, torch.arange(first, len(self._places))

    def frames(self, state: State) -> Float[Tensor, "n c h w"]:
        """What is seen in the states; the simulations must keep pictures."""
        return to_model(self.pixels(state))

    def pixels(self, state: State) -> UInt8[Tensor, "n h w 3"]:
        """The same as whole pixel values."""
        shown = [self._simulations[own].picture(self._places[place]) for own, place in _pairs(state)]
        return torch.from_numpy(np.stack(shown))

    def features(self, state: State) -> Float[Tensor, "n d"]:
        """Not of a simulator.

        Raises:
            InvalidSetting: Always.
        """
        raise InvalidSetting("the oracle has no features; plan it with another '--objective'.")

    def true_costs(self, state: State) -> Float[Tensor, " n"]:
        """What the states cost by the simulator itself (``TaskMeasure.cost``)."""
        return torch.tensor([self._places[place].cost for _, place in _pairs(state)], dtype=torch.float32)


def _pairs(state: State) -> list[tuple[int, int]]:
    return list(zip(state[0].tolist(), state[1].tolist(), strict=True))
