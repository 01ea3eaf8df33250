"""Configs from the command line and from JSON: ``--set KEY=VALUE`` on frozen dataclasses, checked, never guessed."""

from __future__ import annotations

import dataclasses
import difflib
import json
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.values import parse_value

ConfigT = TypeVar("ConfigT")


def _fields(config: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(type(config))
    return {field.name: hints[field.name] for field in dataclasses.fields(config) if field.init}


def with_settings(settings: Sequence[str], *configs: Any, option: str = "--set") -> tuple[Any, ...]:
    """New configs with ``KEY=VALUE`` settings applied; each key belongs to the one config that has it.

    Args:
        settings: As they were typed.
        configs: Whose fields can be set.
        option: Of the command line that they were given with.

    Raises:
        InvalidSetting: No config has the key (the closest is named), or the value is not of its type.
    """
    owners = {name: place for place, config in reversed(list(enumerate(configs))) for name in _fields(config)}
    changes: list[dict[str, Any]] = [{} for _ in configs]
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise InvalidSetting(f"{option} {setting!r} has no value; write {option} {key}=VALUE.")
        if key not in owners:
            near = difflib.get_close_matches(key, owners, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(sorted(owners))}."
            raise InvalidSetting(f"no setting named {key!r}; {hint}")
        place = owners[key]
        changes[place][key] = parse_value(key, text, _fields(configs[place])[key])
    return tuple(dataclasses.replace(config, **change) for config, change in zip(configs, changes, strict=True))


def to_json(config: Any) -> dict[str, Any]:
    """A config as JSON's types, to be read again by ``from_json``."""
    plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return plain


def from_json(kind: type[ConfigT], stored: Mapping[str, Any]) -> ConfigT:
    """The config that ``to_json`` wrote.

    Raises:
        InvalidSetting: A field is unknown, of another type, or missing without a default.
    """
    hints = typing.get_type_hints(kind)
    names = {field.name for field in dataclasses.fields(typing.cast(Any, kind))}
    if unknown := sorted(set(stored) - names):
        raise InvalidSetting(f"{kind.__name__} has no field {', '.join(unknown)}; it was written by another version.")
    values = {
        name: tuple(value) if typing.get_origin(hints[name]) is tuple and isinstance(value, list) else value
        for name, value in stored.items()
    }
    for name, value in values.items():
        if not _is_of(hints[name], value):
            raise InvalidSetting(f"a stored {kind.__name__} cannot be read: {name} is {value!r}.")
    try:
        return kind(**values)
    except TypeError as error:
        raise InvalidSetting(f"a stored {kind.__name__} cannot be read: {error}.") from None


def _is_of(hint: Any, value: Any) -> bool:
    """Whether JSON's value can be one of a field's type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_is_of(one, value) for one in arguments)
    if origin is typing.Literal:
        return value in arguments
    if origin is tuple:
        return isinstance(value, tuple) and all(_is_of(arguments[0], one) for one in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    kind = origin or hint
    return isinstance(value, kind) if isinstance(kind, type) else True
