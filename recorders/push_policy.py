"""The recording policy of the pushing environments, ``push``.

With probability .7 one step toward an object, which is chosen anew with probability .15, else any legal move: about
a third of the steps move an object, and an episode ends after some 40 frames because one falls, as in the paper.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from dmotion_bench.environment import Environment

TOWARD = 0.7
CHOOSE_ANEW = 0.15


@runtime_checkable
class Pushing(Protocol):
    """What the policy needs to know beyond ``Environment``."""

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each action takes the agent [m]."""


class PushPolicy:
    """Goes for one object after another; made anew for each episode."""

    def __init__(self) -> None:
        self._target: int | None = None

    def __call__(self, env: Environment, generator: np.random.Generator) -> int:
        """The next action; ``env`` must also be ``Pushing``."""
        assert isinstance(env, Pushing)
        legal = np.flatnonzero(env.legal_actions())
        objects = env.objects().position[:, :2]
        present = np.flatnonzero(~np.isnan(objects[:, 0]))
        if self._target not in present or generator.random() < CHOOSE_ANEW:
            self._target = int(generator.choice(present)) if len(present) else None
        if self._target is not None and generator.random() < TOWARD:
            way = objects[self._target] - env.agent().position[0, :2]
            gain = env.moves[legal] @ way
            # The longer leg more often than the other, so that the way is no fixed zigzag.
            weights = np.clip(gain, 0.0, None) ** 2
            if weights.sum() > 0:
                return int(generator.choice(legal, p=weights / weights.sum()))
        return int(generator.choice(legal))
