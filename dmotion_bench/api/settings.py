"""Arguments as Python writes them: settings, ``{"epochs": 5}``, as the texts that the command line takes, and numbers.

A whole number may be one of NumPy's. The bounds are those of the command line's options.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any, Final, SupportsIndex, overload

import numpy as np

from dmotion_bench.errors import InvalidSetting, UnknownName, UsageError
from dmotion_bench.specs import Preset, SplitName
from dmotion_bench.wording import shown

Settings = Mapping[str, object] | Sequence[str] | None
"""Settings by name, or ``KEY=VALUE`` texts."""

DEVICES: Final = ("auto", "cpu", "cuda")
EXECUTORS: Final = ("local", "ray", "slurm")
SPLITS: Final[tuple[SplitName, ...]] = ("train", "validation", "test")
SPLIT_PROTOCOLS: Final = ("episode", "paper")
LARGEST_SEED: Final = 2**53 - 1
"""The largest whole number that every reader of JSON reads exactly."""
TRACKERS: Final = ("tensorboard", "wandb")


@overload
def whole(name: str, given: SupportsIndex, least: int | None = ..., most: int | None = ...) -> int: ...
@overload
def whole(name: str, given: None, least: int | None = ..., most: int | None = ...) -> None: ...
def whole(name: str, given: Any, least: int | None = None, most: int | None = None) -> int | None:
    """A whole number as Python's own, or None where None was given.

    Args:
        name: Of the argument.
        given: Its value; ``True`` and ``False`` are no numbers.
        least, most: Its bounds; both can be taken.

    Raises:
        UsageError: It is no whole number, or out of its bounds.
    """
    if given is None:
        return None
    try:
        number = None if isinstance(given, bool | np.bool_) else operator.index(given)
    except TypeError:
        number = None
    if number is None or (least is not None and number < least) or (most is not None and number > most):
        bounds = "" if least is None else f" of {least} or more" if most is None else f" from {least} to {most}"
        raise UsageError(f"{name} is {shown(given)}; it must be a whole number{bounds}.")
    return number


@overload
def number(name: str, given: float) -> float: ...
@overload
def number(name: str, given: float | None) -> float | None: ...
def number(name: str, given: Any) -> float | None:
    """A number as Python's own with a fraction, or None where None was given: 10 and 10.0 are written alike.

    Args:
        name: Of the argument.
        given: Its value; one of NumPy's may be given, ``True`` and ``False`` are no numbers.

    Raises:
        UsageError: It is no number.
    """
    if given is None:
        return None
    try:
        found = float(given) if _is_number(given) else None
    except OverflowError:
        found = None
    if found is None:
        raise UsageError(f"{name} is {shown(given)}; it must be a number.")
    return found


def share(name: str, given: float) -> float:
    """A number from 0 to 1.

    Args:
        name: Of the argument.
        given: Its value.

    Raises:
        UsageError: It is none.
    """
    if not _is_number(given) or not 0 <= given <= 1:
        raise UsageError(f"{name} is {shown(given)}; it must be a share from 0 to 1.")
    return float(given)


def _is_number(given: object) -> bool:
    return isinstance(given, Real) and not isinstance(given, bool)  # NumPy's and fractions are real numbers, too


def require_one_of(kind: str, given: str, allowed: Iterable[str]) -> None:
    """Check a name.

    Raises:
        UnknownName: It is not allowed; the error lists the names that are.
    """
    known = tuple(allowed)
    if given not in known:
        raise UnknownName(kind, str(given), known)


def as_texts(settings: Settings) -> tuple[str, ...]:
    """The settings as ``KEY=VALUE``.

    Raises:
        InvalidSetting: They are one text, or a value cannot be written as one.
    """
    if settings is None:
        return ()
    if isinstance(settings, str):
        raise InvalidSetting(f"settings are {shown(settings)}; give a dictionary, such as {{'epochs': 5}}.")
    if isinstance(settings, Mapping):
        return tuple(f"{name}={_text(name, value)}" for name, value in settings.items())
    given = tuple(settings) if isinstance(settings, Iterable) else (settings,)
    for one in given:
        if not isinstance(one, str):
            raise InvalidSetting(f"a setting is {shown(one)}; it can be a text such as 'epochs=5', or a dictionary.")
    return given


def as_preset(preset: Preset | str) -> Preset:
    """A preset by its name.

    Raises:
        UnknownName: There is none of this name.
    """
    if preset not in set(Preset):
        raise UnknownName("preset", str(preset), [known.value for known in Preset])
    return Preset(preset)


def _text(name: str, value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | int | float):
        return str(value)
    if isinstance(value, list | tuple):
        return ",".join(_text(name, one) for one in value)
    try:
        return _text(name, value.item())  # type: ignore[attr-defined]
    except (AttributeError, TypeError, ValueError, RuntimeError):
        raise InvalidSetting(
            f"the setting {name!r} is {shown(value)}; it can be a number, a word, True, False, None or a list of these."
        ) from None
