"""Resets of a simulator that nobody here has asked for: of one that begins a new episode by itself when one ends."""

from __future__ import annotations

import contextlib
from typing import Any


class Resets:
    """Counts the resets of an environment, by whomever: it takes the place of that method.

    Args:
        env: Without its wrappers, which may be the ones that reset it. A copy of it has a count of its own.

    Attributes:
        count: Until now.
    """

    def __init__(self, env: Any) -> None:
        self.count, self._reset = 0, env.reset
        with contextlib.suppress(AttributeError, TypeError):  # it takes no attributes, and is not watched
            env.reset = self

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Reset the environment."""
        self.count += 1
        return self._reset(*given, **named)
