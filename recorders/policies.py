"""Recording policies that any environment can use."""

from __future__ import annotations

from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Action, Environment
from dmotion_bench.errors import InvalidSetting

KEPT: Final = 0.75
"""Probability that ``StickyPolicy`` takes the action again that it took before."""


@runtime_checkable
class Roomy(Protocol):
    """An environment that cuts short what leads out of the agent's area."""

    @property
    def room(self) -> Float[np.ndarray, "2 a"]:
        """The least and the greatest action that nothing cuts short."""


def require_one_agent(env: Environment, what: str, instead: str) -> None:
    """See that a world has one agent, where something knows how to move one alone.

    Args:
        env: The world.
        what: That thing, as the subject of a sentence.
        instead: What to do with several agents.

    Raises:
        InvalidSetting: It has several.
    """
    if len(env.facts.agents) > 1:
        raise InvalidSetting(f"{what} moves one agent, and {env.facts.id} has {len(env.facts.agents)} here; {instead}.")


class RandomPolicy:
    """Each legal move with the same probability; a continuous action is evenly distributed over the bounds.

    No continuous action leads out of the agent's area: it is cut short, as in ``push_policy``.
    """

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The next action: one random number a step, so that many episodes can be drawn at once."""
        spec = env.facts.actions
        if isinstance(spec, Continuous):
            action = generator.uniform(spec.low, spec.high)
            least, greatest = env.room if isinstance(env, Roomy) else (spec.low, spec.high)
            cut: Float[np.ndarray, " a"] = np.clip(action, np.maximum(spec.low, least), np.minimum(spec.high, greatest))
            return cut
        legal = np.flatnonzero(env.legal_actions())
        return int(legal[int(generator.random() * len(legal))])


class StickyPolicy:
    """Takes the same action for four steps on average, so that it gets farther than by steps that undo each other.

    Made anew for each episode: it remembers its last action.
    """

    def __init__(self) -> None:
        self._last: Action | None = None
        self._fresh = RandomPolicy()

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The last action with the probability ``KEPT``, if it is still legal, else any."""
        keep = generator.random() < KEPT
        last = self._last
        if last is None or not keep or (isinstance(last, int) and not env.legal_actions()[last]):
            last = self._fresh(env, generator)
        self._last = last
        return last
