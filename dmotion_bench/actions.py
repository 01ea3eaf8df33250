"""What an agent can do: one of a few named actions, or a vector of numbers within bounds.

``Discrete`` actions are whole numbers, an episode's are ``Int[t-1]``. What several agents do at once is one such
action, a joint action, whose name holds the names of its parts: ``"up/left"``. ``Continuous`` ones are vectors in the
units that the specification names, an episode's are ``Float[t-1 a]``. ``None`` in the place of a specification says
that the actions are not known, as in imported video.

Actions keep their units everywhere: on disk, in batches, in a model's arguments. Two methods, ``normalise`` and
``denormalise``, lead to [-1, 1] and back; learning/action_encoding.py applies them for models.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.wording import shown

if TYPE_CHECKING:
    import gymnasium

MOST_ACTIONS: Final = 4096  # names of discrete actions
MOST_NUMBERS: Final = 256  # in a continuous action
LONGEST_NAME: Final = 256  # characters
MOST_DESCRIBED: Final = 4  # numbers
JOINT: Final = "/"
"""Stands between the parts of a joint action's name."""
SMALLEST: Final = float(np.finfo(np.float64).tiny)
SLACK: Final = 1e-6
"""Share of its range by which a number may lie outside."""
ROUNDING: Final = 4 * float(np.finfo(np.float32).eps)
"""Share of its larger bound that comes on top: numbers are computed in 32 bits, and a range may be narrow and far from
zero. The type of an array does not say in how many bits its numbers were computed."""


@dataclass(frozen=True)
class Discrete:
    """A few actions, one of which is taken at each step.

    Attributes:
        names: In the order of their numbers.

    Raises:
        InvalidSetting: There is no name, two are the same, or they are one text.
    """

    names: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", _as_tuple("names", self.names))
        _check_names(self.names, MOST_ACTIONS)

    @classmethod
    def numbered(cls, count: int) -> Discrete:
        """So many actions whose names are their numbers."""
        return cls(tuple(map(str, range(count))))

    @classmethod
    def joint(cls, *parts: tuple[str, ...]) -> Discrete:
        """What several agents do at once: every combination of their actions, the last agent's changing fastest.

        Args:
            parts: The names of each agent's actions, two or more; none of them holds a ``"/"``.

        Raises:
            InvalidSetting: An agent has fewer, or a name holds one.
        """
        if any(len(names) < 2 for names in parts):
            raise InvalidSetting("an agent has fewer than 2 actions; a joint action has at least 2 of each agent.")
        if wrong := [name for names in parts for name in names if JOINT in name]:
            raise InvalidSetting(f"an agent's action is {shown(wrong[0])}; its name must hold no {JOINT!r}.")
        return cls(tuple(map(JOINT.join, itertools.product(*parts))))

    @cached_property
    def parts(self) -> tuple[tuple[str, ...], ...]:
        """The names of each agent's actions: what ``joint`` was given, or ``(names,)`` of actions of another kind.

        The names say it: an action is joint if the names are all combinations of their parts, in ``joint``'s order.
        """
        split = [name.split(JOINT) for name in self.names]
        if len({len(one) for one in split}) == 1:
            parts = tuple(tuple(dict.fromkeys(column)) for column in zip(*split, strict=True))
            several = all(len(names) > 1 for names in parts) and math.prod(map(len, parts)) == len(split)
            if several and split == list(map(list, itertools.product(*parts))):
                return parts
        return (self.names,)

    def divided(self, actions: Int[np.ndarray, "*b"]) -> Int[np.ndarray, "*b p"]:
        """The number of each part of joint actions: row and column ``p`` counts the actions of ``parts[p]``."""
        numbers = np.unravel_index(actions, tuple(map(len, self.parts)))
        return np.stack(numbers, axis=-1).astype(np.int64)

    def __len__(self) -> int:
        """The number of actions."""
        return len(self.names)

    @property
    def width(self) -> int:
        """Length of the vector that tells a model which action it is: one-hot."""
        return len(self.names)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one action, as an array."""
        return ()

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of actions, as an array."""
        return np.dtype(np.int64)

    def space(self) -> gymnasium.Space[Any]:
        """The actions, as Gymnasium describes them."""
        from gymnasium.spaces import Discrete as Space

        return Space(len(self))

    def fault(self, actions: Any, where: str = "at step") -> str | None:
        """What is wrong with an array of actions, to follow "holds"; None if nothing is.

        Args:
            actions: One a row.
            where: How a row is spoken of.
        """
        values = np.asarray(actions)
        if values.ndim != 1 or not (np.issubdtype(values.dtype, np.integer) or not values.size):
            return f"actions of the type {values.dtype} and the shape {values.shape}, not one whole number each"
        wrong = np.flatnonzero((values < 0) | (values >= len(self)))
        if len(wrong):
            return f"action {values[wrong[0]]} {where} {wrong[0]}; there are {len(self)}, numbered from 0"
        return None

    def fits(self, other: ActionSpec | None) -> bool:
        """Whether a model made for these actions can be given those: as many, whatever their names."""
        return isinstance(other, Discrete) and len(other) == len(self)

    def describe(self, action: Any) -> str:
        """An action in words: its name."""
        return self.names[int(action)]

    def __str__(self) -> str:
        return ", ".join(self.names)


@dataclass(frozen=True, kw_only=True)
class Continuous:
    """A vector of numbers, each within its bounds.

    Attributes:
        names: Of the numbers: ``"dx"``, ``"dy"``.
        low, high: The bounds, in the units; both can be taken.
        units: Such as ``"m"``; empty where they are not known.

    Raises:
        InvalidSetting: There is no number, two have the same name, a bound cannot be, or a field is no tuple.
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    units: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("names", "low", "high", "units"):
            object.__setattr__(self, name, _as_tuple(name, getattr(self, name)))
        _check_names(self.names, MOST_NUMBERS)
        if not len(self.names) == len(self.low) == len(self.high) == len(self.units):
            raise InvalidSetting(
                f"the actions have {len(self.names)} names, {len(self.low)} and {len(self.high)} bounds, and "
                f"{len(self.units)} units; give as many of each."
            )
        for unit in self.units:
            if not isinstance(unit, str) or len(unit) > LONGEST_NAME:
                raise InvalidSetting(f"a unit of the actions is {shown(unit)}; it must be a short text, such as 'm'.")
        for name, low, high in zip(self.names, self.low, self.high, strict=True):
            if not (_is_number(low) and _is_number(high)):
                raise InvalidSetting(f"{shown(name)} goes from {shown(low)} to {shown(high)}; bounds are numbers.")
            if not (math.isfinite(low) and math.isfinite(high) and low < high and math.isfinite(high - low)):
                raise InvalidSetting(
                    f"{shown(name)} goes from {low} to {high}; the lower bound must be below the upper, both finite."
                )

    @property
    def width(self) -> int:
        """Numbers in an action."""
        return len(self.names)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one action, as an array."""
        return (len(self.names),)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of actions, as an array."""
        return np.dtype(np.float64)

    @property
    def middle(self) -> Float[np.ndarray, " a"]:
        """What becomes 0."""
        return (np.asarray(self.low, np.float64) + np.asarray(self.high, np.float64)) / 2

    @property
    def reach(self) -> Float[np.ndarray, " a"]:
        """How far the bounds are from the middle."""
        return (np.asarray(self.high, np.float64) - np.asarray(self.low, np.float64)) / 2

    def normalise(self, actions: Float[np.ndarray, "*b a"]) -> Float[np.ndarray, "*b a"]:
        """From the units to [-1, 1]."""
        normal: Float[np.ndarray, "*b a"] = (np.asarray(actions, np.float64) - self.middle) / self.reach
        return normal

    def denormalise(self, normal: Float[np.ndarray, "*b a"]) -> Float[np.ndarray, "*b a"]:
        """From [-1, 1] to the units."""
        actions: Float[np.ndarray, "*b a"] = np.asarray(normal, np.float64) * self.reach + self.middle
        return actions

    def beyond(self, actions: Float[np.ndarray, "b a"]) -> Bool[np.ndarray, "b a"]:
        """Which numbers lie beyond their bounds, more than rounding explains; NaN does."""
        low, high = np.asarray(self.low, np.float64), np.asarray(self.high, np.float64)
        slack = 2 * self.reach * SLACK + np.maximum(np.abs(low), np.abs(high)) * ROUNDING
        with np.errstate(invalid="ignore"):
            inside = (actions >= low - slack) & (actions <= high + slack)
        return ~np.asarray(inside, np.bool_)

    def space(self) -> gymnasium.Space[Any]:
        """The actions, as Gymnasium describes them."""
        from gymnasium.spaces import Box

        return Box(np.asarray(self.low, np.float64), np.asarray(self.high, np.float64), dtype=np.float64)

    def fault(self, actions: Any, where: str = "at step") -> str | None:
        """What is wrong with an array of actions, to follow "holds"; None if nothing is.

        Args:
            actions: One a row.
            where: How a row is spoken of.
        """
        values = np.asarray(actions)
        if values.ndim != 2 or values.shape[1] != self.width or not np.issubdtype(values.dtype, np.floating):
            return (
                f"actions of the type {values.dtype} and the shape {values.shape}, "
                f"not {self.width} floating-point numbers each"
            )
        wrong = np.argwhere(self.beyond(values))
        if len(wrong):
            row, place = wrong[0].tolist()
            return (
                f"{shown(self.names[place])} = {values[row, place]:.6g} {where} {row}; it can be {self._range(place)}"
            )
        return None

    def fits(self, other: ActionSpec | None) -> bool:
        """Whether a model made for these actions can be given those: the same bounds, whatever their names."""
        return isinstance(other, Continuous) and (other.low, other.high) == (self.low, self.high)

    def describe(self, action: Any) -> str:
        """An action in words: its numbers with their names and units, rounded; of many, the first few."""
        said = []
        for name, number, unit, reach in zip(self.names, action, self.units, self.reach.tolist(), strict=True):
            digits = 2 - math.floor(math.log10(max(reach, SMALLEST)))
            said.append(f"{name} {round(float(number), digits) + 0.0:g} {unit}".rstrip())  # with 0 for -0
        more = len(said) - MOST_DESCRIBED
        return ", ".join(said if more <= 0 else [*said[:MOST_DESCRIBED], f"and {more} more"])

    def _range(self, place: int) -> str:
        return f"{self.low[place]:g} to {self.high[place]:g} {self.units[place]}".rstrip()

    def __str__(self) -> str:
        return ", ".join(f"{name} ({self._range(place)})" for place, name in enumerate(self.names))


ActionSpec = Discrete | Continuous


ActionKind = Literal["discrete", "continuous", "joint"]


def kind_of(spec: ActionSpec | None) -> ActionKind:
    """Whether actions are continuous, of several agents at once, or neither, which stands for unknown ones, too."""
    if isinstance(spec, Continuous):
        return "continuous"
    return "joint" if spec is not None and len(spec.parts) > 1 else "discrete"


ActionTaken = int | tuple[float, ...]
"""One action: the number of a discrete one, or the numbers of a continuous one in their units."""


def as_actions(rows: Int[np.ndarray, " t"] | Float[np.ndarray, "t a"]) -> list[ActionTaken]:
    """Actions one by one, in a form that can be compared."""
    return [tuple(row) if isinstance(row, list) else row for row in rows.tolist()]


def given(action: ActionTaken) -> int | Float[np.ndarray, " a"]:
    """An action as an environment takes it."""
    return np.array(action) if isinstance(action, tuple) else action


def require_discrete(spec: ActionSpec | None, what: str) -> Discrete:
    """The specification, where something works for discrete actions alone.

    Args:
        spec: Of the data set or environment.
        what: It, as the subject of a sentence: ``"planning"``.

    Raises:
        InvalidSetting: The actions are continuous, or not known.
    """
    if isinstance(spec, Discrete):
        return spec
    found = "are not known" if spec is None else f"are continuous: {spec}"
    raise InvalidSetting(f"{what} needs discrete actions, and these {found}; take a data set with discrete actions.")


def actions_to_json(spec: ActionSpec | None) -> list[str] | dict[str, list[Any]]:
    """As ``dataset.json`` holds it: a list of names, empty if unknown, or an object of a continuous action's fields."""
    if isinstance(spec, Continuous):
        return {name: list(getattr(spec, name)) for name in ("names", "low", "high", "units")}
    return [] if spec is None else list(spec.names)


def actions_from_json(value: object) -> ActionSpec | None:
    """What ``actions_to_json`` wrote.

    Raises:
        ValueError: It is no such thing; says what is wrong, without the last full stop.
    """
    try:
        if isinstance(value, list):
            return Discrete(tuple(value)) if value else None
        if isinstance(value, dict):
            fields = ("names", "low", "high", "units")
            if set(value) != set(fields) or not all(isinstance(value[name], list) for name in fields):
                raise ValueError(f"the actions are {shown(value)}, not the lists {', '.join(fields)}")
            return Continuous(**{name: tuple(value[name]) for name in fields})
    except InvalidSetting as error:
        raise ValueError(str(error).rstrip(".")) from None
    raise ValueError(f"the actions are {shown(value)}, neither names nor a continuous action")


def _is_number(value: object) -> bool:
    return type(value) is float or (type(value) is int and abs(value) <= 2**53)


def _as_tuple(field: str, value: object) -> tuple[Any, ...]:
    """A list as a tuple; a text is refused, since its letters would be taken for names.

    Raises:
        InvalidSetting: It is neither a tuple nor a list.
    """
    if not isinstance(value, tuple | list):
        raise InvalidSetting(f"{field} of actions is {shown(value)}; give a tuple, such as ({shown(value)},).")
    return tuple(value)


def _check_names(names: tuple[str, ...], most: int) -> None:
    if not 1 <= len(names) <= most:
        raise InvalidSetting(f"there are {len(names):,} actions; there can be 1 to {most:,}.")
    for name in names:
        if not isinstance(name, str):
            raise InvalidSetting(f"the name of an action is {shown(name)}; it must be a text.")
        if len(name) > LONGEST_NAME:
            raise InvalidSetting(f"the action {shown(name)} has a name longer than {LONGEST_NAME:,} characters.")
        try:
            name.encode()
        except UnicodeEncodeError:
            raise InvalidSetting(f"the action {shown(name)} has a name that is not UTF-8 text.") from None
    if len(set(names)) != len(names):
        raise InvalidSetting("two of the actions have the same name; name them apart.")
