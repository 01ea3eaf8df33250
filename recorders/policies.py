"""Recording policies that any environment can use."""

from __future__ import annotations

from typing import Final

import numpy as np

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Action, Environment

KEPT: Final = 0.75
"""Probability that ``StickyPolicy`` takes the action again that it took before."""


class RandomPolicy:
    """Each legal move with the same probability."""

    def __call__(self, env: Environment, generator: np.random.Generator) -> int:
        """The next action: one random number a step, so that many episodes can be drawn at once."""
        legal = np.flatnonzero(env.legal_actions())
        return int(legal[int(generator.random() * len(legal))])


class UniformPolicy:
    """Any action, all with the same probability: a legal discrete one, or numbers between their bounds."""

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The next action."""
        if isinstance(env.facts.actions, Continuous):
            return generator.uniform(env.facts.actions.low, env.facts.actions.high)
        return RandomPolicy()(env, generator)


class StickyPolicy:
    """Takes the same action for four steps on average, so that it gets farther than by steps that undo each other.

    Made anew for each episode: it remembers its last action.
    """

    def __init__(self) -> None:
        self._last: Action | None = None
        self._fresh = UniformPolicy()

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The last action with the probability ``KEPT``, if it is still legal, else any."""
        keep = generator.random() < KEPT
        last = self._last
        if last is None or not keep or (isinstance(last, int) and not env.legal_actions()[last]):
            last = self._fresh(env, generator)
        self._last = last
        return last
