"""Recording policies that any environment can use."""

from __future__ import annotations

import numpy as np

from dmotion_bench.environment import Environment


class RandomPolicy:
    """Each legal move with the same probability."""

    def __call__(self, env: Environment, generator: np.random.Generator) -> int:
        """The next action: one random number a step, so that many episodes can be drawn at once."""
        legal = np.flatnonzero(env.legal_actions())
        return int(legal[int(generator.random() * len(legal))])
