"""Random streams of an episode, one for each factor."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

State = TypeVar("State")


def stream(entropy: int, factor: str, family: int) -> np.random.Generator:
    """The random numbers of a factor in an episode.

    Args:
        entropy: Of the episode.
        factor: Its name.
        family: Scenes of other families have other numbers under the same seed.
    """
    key = (zlib.crc32(factor.encode()), family)
    return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=key))


class Track(Generic[State]):
    """A state that changes from moment to moment, computed as far as it is asked for.

    Moments may be asked for in any order, as a simulator that is put back does; the answers are the same.

    Args:
        first: At moment 0.
        after: What follows a state; it draws as many random numbers at every moment.
    """

    def __init__(self, first: State, after: Callable[[State], State]) -> None:
        self._states, self._after = [first], after

    def at(self, moment: int) -> State:
        """The state after so many steps."""
        while len(self._states) <= moment:
            self._states.append(self._after(self._states[-1]))
        return self._states[moment]
