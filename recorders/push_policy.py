"""The recording policy of the pushing environments, ``push``.

With probability .7 one step toward an object, which is chosen anew with probability .15, else any legal move: about
a third of the steps move an object, and an episode ends after some 40 frames because one falls, as in the paper.
"""

from __future__ import annotations

import math
from typing import Protocol, cast

import numpy as np
from jaxtyping import Float

from dmotion_bench.environment import Environment

TOWARD = 0.7
CHOOSE_ANEW = 0.15


class Pushing(Protocol):
    """What the policy needs to know beyond ``Environment``."""

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each action takes the agent [m]."""


class PushPolicy:
    """Goes for one object after another; made anew for each episode."""

    def __init__(self) -> None:
        self._target: int | None = None
        self._moves: list[list[float]] = []

    def __call__(self, env: Environment, generator: np.random.Generator) -> int:
        """The next action; ``env`` must also be ``Pushing``."""
        legal = [action for action, possible in enumerate(env.legal_actions().tolist()) if possible]
        objects: list[list[float]] = env.objects().position.tolist()
        present = [index for index, position in enumerate(objects) if not math.isnan(position[0])]
        if self._target not in present or generator.random() < CHOOSE_ANEW:
            self._target = present[int(generator.random() * len(present))] if present else None
        if self._target is not None and generator.random() < TOWARD:
            there, here = objects[self._target], env.agent().position[0].tolist()
            x, y = there[0] - here[0], there[1] - here[1]
            self._moves = moves = self._moves or cast(Pushing, env).moves.tolist()
            # The longer leg more often than the other, so that the way is no fixed zigzag.
            weights = [max(0.0, moves[action][0] * x + moves[action][1] * y) ** 2 for action in legal]
            if sum(weights) > 0:
                return legal[_drawn(weights, generator.random())]
        return legal[int(generator.random() * len(legal))]


def _drawn(weights: list[float], number: float) -> int:
    """An index with a probability in proportion to its weight, by a number in [0, 1)."""
    left = number * sum(weights)
    for index, weight in enumerate(weights):
        left -= weight
        if left < 0:
            return index
    return max(range(len(weights)), key=weights.__getitem__)
