"""Gymnasium's action spaces as ``ActionSpec``, and actions on their way back."""

from __future__ import annotations

import contextlib
from typing import Any, Final

import numpy as np
from gymnasium import Wrapper
from gymnasium.spaces import Box, Space
from gymnasium.spaces import Discrete as DiscreteSpace

from dmotion_bench.actions import MOST_NUMBERS, ActionSpec, Continuous, Discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.wording import shown

_ALLOWED: Final = "only 'Discrete' and bounded 'Box' spaces can be recorded"
_WRAP: Final = "a 'gymnasium.ActionWrapper' of yours gives it others with '--set wrappers=MODULE:CLASS'"


def action_spec(name: str, env: Any) -> ActionSpec:
    """The actions of an environment.

    Args:
        name: Of the environment, for sentences.
        env: Made by Gymnasium.

    Raises:
        InvalidSetting: They are of a kind that cannot be recorded.
    """
    space: Space[Any] = env.action_space
    if isinstance(space, DiscreteSpace):
        return Discrete(_names(env, range(int(space.start), int(space.start) + int(space.n))))
    kind = type(space).__name__
    if not isinstance(space, Box):
        raise InvalidSetting(f"the actions of {name!r} are a space of the kind {kind!r}, and {_ALLOWED}; {_WRAP}.")
    low, high = (np.asarray(bound, np.float64).reshape(-1) for bound in (space.low, space.high))
    if not np.issubdtype(space.dtype, np.floating):
        raise InvalidSetting(
            f"the actions of {name!r} are whole numbers in a 'Box' ({space.dtype}), and {_ALLOWED}, of floating-point "
            f"numbers; {_WRAP}."
        )
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InvalidSetting(
            f"the actions of {name!r} have no finite bounds: {shown(str(space))}, and {_ALLOWED}; {_WRAP}."
        )
    if len(fixed := np.flatnonzero(low >= high)):
        raise InvalidSetting(
            f"number {fixed[0]} of the actions of {name!r} can only be {low[fixed[0]]:g}: {shown(str(space))}; leave "
            f"such numbers out: {_WRAP}."
        )
    if not 1 <= len(low) <= MOST_NUMBERS:
        raise InvalidSetting(
            f"an action of {name!r} has {len(low)} numbers; it can have 1 to {MOST_NUMBERS}, so it cannot be recorded."
        )
    names = tuple(f"a{place}" for place in range(len(low)))
    return Continuous(names=names, low=tuple(low.tolist()), high=tuple(high.tolist()), units=("",) * len(low))


def _names(env: Any, numbers: range) -> tuple[str, ...]:
    """What the environment calls its actions: Atari's meanings, an enumeration as in MiniGrid, else their numbers.

    The outermost wrapper that names them is asked, since it may have exchanged them. What lies below a wrapper with an
    action space of its own names other actions.
    """
    named: list[str] = []
    with contextlib.suppress(Exception):  # both are customs that nobody has to keep, and numbers do as well
        while isinstance(env, Wrapper) and not (hasattr(env, "get_action_meanings") or hasattr(env, "actions")):
            if env.action_space is not env.env.action_space:
                break
            env = env.env
        if hasattr(env, "get_action_meanings"):
            named = [str(name).lower() for name in env.get_action_meanings()]
        elif hasattr(actions := env.actions, "__members__"):
            members = {int(one.value): str(one.name) for one in actions}
            named = [members.get(number, "") for number in numbers]
    if len(named) == len(set(named)) == len(numbers) and all(named):
        return tuple(named)
    return tuple(map(str, numbers))


def for_simulator(space: Space[Any], action: Any) -> Any:
    """An action as the simulator takes it: counted from the space's start, or of its shape and precision."""
    if isinstance(space, DiscreteSpace):
        return int(action) + int(space.start)
    assert isinstance(space, Box), _ALLOWED
    values = np.asarray(action, space.dtype).reshape(space.shape)
    return np.clip(values, space.low, space.high)  # what rounding to 32 bits took beyond a bound
