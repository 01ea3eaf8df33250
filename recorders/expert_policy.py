"""The recording policy ``expert-correlated``: what a scripted expert does for a task, mixed with random actions.

It sets itself a task: one object is to be some steps farther along one of the actions' directions. With probability
.8 it takes the action of the environment's script for this task, else a random one. When the task is done, the script
knows no way, or it takes too long, it sets itself another. So actions depend on where everything is, as in
demonstrations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Protocol, cast

import numpy as np
from jaxtyping import Float

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Action, Environment, HasScript, ObjectEnvironment, Script
from dmotion_bench.specs import ObjectStates
from recorders.policies import RandomPolicy, Roomy, require_one_agent
from recorders.push_policy import Pushing

EXPERT: Final = 0.8
SHORTEST, LONGEST = 2, 4  # steps that an object is to be moved
TRIES: Final = 8  # tasks that are considered at one step
PATIENCE: Final = 30  # steps that one task may take


class Bounded(Pushing, HasScript, Protocol):
    """What the policy needs to know of an environment."""

    @property
    def goals(self) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest place along x and y that an object may be pushed to [m]."""

    @property
    def area(self) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest place along x and y where the agent can be [m]."""


class ExpertPolicy:
    """Solves one small task after another; made anew for each episode."""

    def __init__(self) -> None:
        self._random = RandomPolicy()
        self._script: Script | None = None
        self._goal: ObjectStates | None = None
        self._steps = 0

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The next action; ``env`` must also be ``Bounded``."""
        require_one_agent(env, "the policy 'expert-correlated'", "record with --policy random")
        script = self._script = self._script or cast(Bounded, env).script()
        script.watch(env)
        self._steps += 1
        if self._steps > PATIENCE:
            self._goal = None
        if generator.random() >= EXPERT:
            return self._random(env, generator)
        for _ in range(TRIES):
            chosen = None if self._goal is None else script.act(env, self._goal)
            if chosen is not None and _possible(env, chosen):
                return chosen
            self._goal, self._steps = _new_goal(env, generator), 0
        return self._random(env, generator)


def _possible(env: Environment, action: Action) -> bool:
    if not isinstance(env.facts.actions, Continuous):
        return bool(env.legal_actions()[action])
    least, greatest = cast(Roomy, env).room
    return bool((action >= least).all() and (action <= greatest).all())


def _new_goal(env: Environment, generator: np.random.Generator) -> ObjectStates | None:
    """The objects with one of them elsewhere; None where it cannot be pushed there, or nothing is there."""
    objects, moves = cast(ObjectEnvironment, env).objects(), cast(Bounded, env).moves
    present = np.flatnonzero(~np.isnan(objects.position[:, 0]))
    one, move, steps = generator.random(3).tolist()
    if not len(present):
        return None
    index, way = int(present[int(one * len(present))]), moves[int(move * len(moves))]
    wanted = objects.position.copy()
    behind = wanted[index, :2] - way
    wanted[index, :2] += (SHORTEST + int(steps * (LONGEST + 1 - SHORTEST))) * way
    reachable = _within(behind, cast(Bounded, env).area) and _within(wanted[index, :2], cast(Bounded, env).goals)
    return replace(objects, position=wanted) if reachable else None


def _within(place: Float[np.ndarray, "2"], bounds: Float[np.ndarray, "2 2"]) -> bool:
    return bool((place >= bounds[0]).all() and (place <= bounds[1]).all())
