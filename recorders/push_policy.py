"""The recording policy ``object-directed``, which the pushing environments also call ``push``.

With probability .7 one step toward an object, which is chosen anew with probability .15, else any legal move: about
a third of the steps move an object, and an episode ends after some 40 frames because one falls, as in the paper.

With continuous actions a step toward an object has a length between half a step and a whole one and misses the
direction by up to 30 degrees; any other is evenly distributed over the bounds. No step leads out of the pusher's area.
"""

from __future__ import annotations

import math
from typing import Protocol, cast

import numpy as np
from jaxtyping import Bool, Float

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Action, Environment, ObjectEnvironment
from recorders.policies import require_one_agent

TOWARD = 0.7
CHOOSE_ANEW = 0.15
ASTRAY = math.pi / 6  # [rad] by which a displacement misses its direction, at most
SHORTEST = 0.5  # displacement toward an object, of the longest


class Pushing(ObjectEnvironment, Protocol):
    """What the policy needs to know beyond ``ObjectEnvironment``."""

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each discrete action takes the agent [m]."""

    @property
    def room(self) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest displacement that nothing cuts short [m]."""


class Careful(Protocol):
    """What an environment may tell where one step toward an object may lose it for good."""

    def careful_actions(self) -> Bool[np.ndarray, " a"]:
        """Which legal actions lose nothing; the policy goes toward an object by these alone."""


class PushPolicy:
    """Goes for one object after another; made anew for each episode."""

    def __init__(self) -> None:
        self._target: int | None = None
        self._moves: list[list[float]] = []

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The next action; ``env`` must also be ``Pushing``."""
        require_one_agent(env, "the policy 'object-directed'", "record with --policy random")
        world = cast(Pushing, env)
        if isinstance(world.facts.actions, Continuous):
            return self._displacement(world, world.facts.actions, generator)
        legal = [action for action, possible in enumerate(world.legal_actions().tolist()) if possible]
        objects: list[list[float]] = world.objects().position.tolist()
        present = [index for index, position in enumerate(objects) if not math.isnan(position[0])]
        if self._target not in present or generator.random() < CHOOSE_ANEW:
            self._target = present[int(generator.random() * len(present))] if present else None
        if self._target is not None and generator.random() < TOWARD:
            there, here = objects[self._target], world.agent().position[0].tolist()
            x, y = there[0] - here[0], there[1] - here[1]
            self._moves = moves = self._moves or world.moves.tolist()
            # The longer leg more often than the other, so that the way is no fixed zigzag.
            if hasattr(env, "careful_actions"):  # a tenth of the time that isinstance takes
                legal = np.flatnonzero(cast(Careful, env).careful_actions()).tolist() or legal
            weights = [max(0.0, moves[action][0] * x + moves[action][1] * y) ** 2 for action in legal]
            if sum(weights) > 0:
                return legal[_drawn(weights, generator.random())]
        return legal[int(generator.random() * len(legal))]

    def _displacement(self, world: Pushing, spec: Continuous, generator: np.random.Generator) -> Float[np.ndarray, "2"]:
        positions = world.objects().position[:, :2]
        present = np.flatnonzero(~np.isnan(positions[:, 0])).tolist()
        if self._target not in present or generator.random() < CHOOSE_ANEW:
            self._target = present[int(generator.random() * len(present))] if present else None
        low, high = np.asarray(spec.low), np.asarray(spec.high)
        if self._target is not None and generator.random() < TOWARD:
            x, y = positions[self._target] - world.agent().position[0, :2]
            direction = math.atan2(y, x) + generator.uniform(-ASTRAY, ASTRAY)
            way = float(high.min()) * generator.uniform(SHORTEST, 1) * np.array([np.cos(direction), np.sin(direction)])
        else:
            way = generator.uniform(low, high)
        least, greatest = world.room
        displacement: Float[np.ndarray, "2"] = np.clip(way, np.maximum(low, least), np.minimum(high, greatest))
        return displacement


def _drawn(weights: list[float], number: float) -> int:
    """An index with a probability in proportion to its weight, by a number in [0, 1)."""
    left = number * sum(weights)
    for index, weight in enumerate(weights):
        left -= weight
        if left < 0:
            return index
    return max(range(len(weights)), key=weights.__getitem__)
