"""Resets of a simulator that nobody here has asked for: of one that begins a new episode by itself when one ends."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
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


def is_first(info: Any) -> bool:
    """Whether a step says beside its frame that it is the first of an episode, as those of dm_env do.

    A simulator of dm_env begins anew in the step after the last one, without its ``reset``. What stands for it in
    Gymnasium hands its ``StepType`` or its ``TimeStep`` on, of which exactly one of ``first``, ``mid`` and ``last`` is
    true.

    Args:
        info: What ``step`` returns at last.
    """
    with contextlib.suppress(Exception):  # whatever somebody else keeps there
        for told in info.values() if isinstance(info, Mapping) else ():
            kinds: list[Any] = [getattr(told, name, None) for name in ("first", "mid", "last")]
            if all(map(callable, kinds)) and [kind() for kind in kinds] == [True, False, False]:
                return True
    return False
