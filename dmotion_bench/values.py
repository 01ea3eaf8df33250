"""Values from the text of a command line, each parsed as the type of its field, without guessing.

Only where nobody says the type (``Any``) is it the first that the text can be: none, truth, a number, a word.
"""

from __future__ import annotations

import math
import types
import typing
from typing import Any, Union

from dmotion_bench.errors import InvalidSetting


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
    if origin is typing.Literal:
        choices = {str(choice): choice for choice in arguments}
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
