"""Values of configs: parsed from the text of a command line as the type of their field, and held to their bounds.

Only where nobody says the type (``Any``) is it the first that the text can be: none, truth, a number, a word.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import types
import typing
from collections.abc import Callable, Iterable
from typing import Any, Union

from dmotion_bench.errors import InvalidSetting


def require_bounds(
    config: object,
    *,
    from_one: Iterable[str] = (),
    above_zero: Iterable[str] = (),
    from_zero: Iterable[str] = (),
    below_one: Iterable[str] = (),
) -> None:
    """Check fields of a config that hold numbers.

    Args:
        config: Whose fields are checked.
        from_one, above_zero, from_zero, below_one: Names of fields; the last are shares, from zero to below one.

    Raises:
        InvalidSetting: A number is out of its bounds, or not finite.
    """
    rules: tuple[tuple[Iterable[str], Callable[[float], bool], str], ...] = (
        (from_one, lambda number: number >= 1, "must be 1 or more"),
        (above_zero, lambda number: number > 0, "must be above zero"),
        (from_zero, lambda number: number >= 0, "cannot be below zero"),
        (below_one, lambda number: 0 <= number < 1, "must be in [0, 1)"),
    )
    for names, fits, rule in rules:
        for name in names:
            number = getattr(config, name)
            if not (fits(number) and number < math.inf):
                raise InvalidSetting(f"{name} is {number}; it {rule}.")


def is_frozen_dataclass(kind: object) -> bool:
    """Whether this is a class of settings that stay as a report says they were."""
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return False
    config: Any = kind
    return bool(config.__dataclass_params__.frozen)


def parse_value(key: str, text: str, wanted: Any) -> Any:
    """The value that a text stands for: a number, truth, word, choice, or several separated by commas.

    Raises:
        InvalidSetting: It is not of the type ``wanted``.
    """
    if wanted is Any:
        return _read(text)
    origin, arguments = typing.get_origin(wanted), typing.get_args(wanted)
    if origin in (Union, types.UnionType):
        if text == "none" and type(None) in arguments:
            return None
        return parse_value(key, text, next(kind for kind in arguments if kind is not type(None)))
    members = isinstance(wanted, type) and issubclass(wanted, enum.Enum)
    if members or origin is typing.Literal:
        choices = {str(one.value): one for one in wanted} if members else {str(choice): choice for choice in arguments}
        if text not in choices:
            raise InvalidSetting(f"{key} is {text!r}; it can be {', '.join(choices)}.")
        return choices[text]
    if origin is tuple:
        return tuple(parse_value(key, part, arguments[0]) for part in text.split(",") if part)
    if wanted is bool:
        if text.lower() not in ("true", "false"):
            raise InvalidSetting(f"{key} is {text!r}; it can be true or false.")
        return text.lower() == "true"
    if wanted in (int, float):
        try:
            value = wanted(text)
        except ValueError:
            kind = "a whole number" if wanted is int else "a number"
            raise InvalidSetting(f"{key} is {text!r}; it must be {kind}.") from None
        if not math.isfinite(value):
            raise InvalidSetting(f"{key} is {text!r}; it must be finite.")
        return value
    return text


def _read(text: str) -> Any:
    """What a text looks like."""
    known = {"none": None, "true": True, "false": False}
    if text.lower() in known:
        return known[text.lower()]
    for kind in (int, float):
        try:
            value = kind(text)
        except ValueError:
            continue
        if math.isfinite(value):
            return value
    return text
