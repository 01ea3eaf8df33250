"""Configs from the command line and from JSON: ``--set KEY=VALUE`` on frozen dataclasses, checked, never guessed."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import enum
import json
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NoReturn, TypeVar

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import DmbenchError, InvalidSetting
from dmotion_bench.storage.json_file import parse_json
from dmotion_bench.values import parse_value

ConfigT = TypeVar("ConfigT")
_NEEDS: Final = "needs"
_ACTIONS: Final = "actions"


def only_with(default: Any, needed: str, holds: Callable[[Any], bool]) -> Any:
    """The default of a field that does something only together with another one; ``with_settings`` refuses it else.

    A stored config may hold any value of it: what did nothing in an earlier run does nothing in it now.

    Args:
        default: Of the field.
        needed: What it takes, for the sentence.
        holds: Whether a config has that.
    """
    return dataclasses.field(default=default, metadata={_NEEDS: (needed, holds)})


def only_for(default: Any, kind: type[Discrete] | type[Continuous]) -> Any:
    """The default of a field that does something with one kind of action alone; ``require_use`` refuses it else.

    A stored report may hold any value of it, as with ``only_with``.

    Args:
        default: Of the field.
        kind: Of the actions.
    """
    return dataclasses.field(default=default, metadata={_ACTIONS: kind})


def _types(kind: type) -> dict[str, Any]:
    """The type of each field of a config.

    Raises:
        InvalidSetting: One is not known where the config is defined.
    """
    try:
        return typing.get_type_hints(kind)
    except NameError as error:
        raise InvalidSetting(
            f"the types of the fields of {kind.__qualname__} cannot be read: {error}; import it, or define it, at the "
            "top of the module."
        ) from None


def _fields(config: Any) -> dict[str, Any]:
    hints = _types(type(config))
    return {field.name: hints[field.name] for field in dataclasses.fields(config) if field.init}


def with_settings(settings: Sequence[str], *configs: Any, option: str = "--set") -> tuple[Any, ...]:
    """New configs with ``KEY=VALUE`` settings applied; each key belongs to the one config that has it.

    Args:
        settings: As they were typed.
        configs: Whose fields can be set.
        option: Of the command line that they were given with.

    Raises:
        InvalidSetting: No config has the key (the closest is named), the value is not of its type, the config refuses
            it, or it would do nothing (``only_with``).
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
        changes[place][key] = _value(key, text, _fields(configs[place])[key])
    try:
        made = [dataclasses.replace(config, **change) for config, change in zip(configs, changes, strict=True)]
    except DmbenchError:
        raise
    except Exception as error:  # of somebody else's config, which may refuse a value by any
        said = str(error).rstrip(".") or type(error).__name__
        raise InvalidSetting(f"{option} {' '.join(settings)} cannot be: {said}.") from None
    for before, config, change in zip(configs, made, changes, strict=True):
        _require_use(before, config, change, option)
    return tuple(made)


def _value(key: str, text: str, wanted: Any) -> Any:
    """What a text says of a field.

    Raises:
        InvalidSetting: It is not of the field's type, or no text says a value of that type.
    """
    value = parse_value(key, text, wanted)
    try:
        decoded(wanted, value)
    except ValueError:
        raise InvalidSetting(
            f"{key} cannot be set, since its type is {wanted}; a field that can be set is a number, a word, true or "
            "false, a choice (Literal, Enum), or a tuple of these, such as tuple[int, ...]."
        ) from None
    return value


def _require_use(before: Any, config: Any, change: Mapping[str, Any], option: str) -> None:
    """Refuse settings that do nothing, if they name another value than the usual one.

    Raises:
        InvalidSetting: One lacks what it does something with.
    """
    for field in dataclasses.fields(config):
        if field.name not in change or change[field.name] in (getattr(before, field.name), field.default):
            continue
        needed, holds = field.metadata.get(_NEEDS, ("", lambda _: True))
        if not holds(config):
            raise InvalidSetting(
                f"{option} {field.name}={change[field.name]} does nothing without {needed}; leave it out, or ask for "
                "that, too."
            )


def require_use(config: Any, actions: ActionSpec | None, option: str) -> None:
    """Refuse a config that holds another value than the usual one where it does nothing with these actions.

    Args:
        config: Of which some fields are for one kind of action alone (``only_for``).
        actions: What can be done; None where that is not known, so that nothing is refused.
        option: Of the command line that the config was made with.

    Raises:
        InvalidSetting: A field is for the other kind of action.
    """
    for field in dataclasses.fields(config):
        kind, value = field.metadata.get(_ACTIONS, object), getattr(config, field.name)
        if actions is not None and not isinstance(actions, kind) and value != field.default:
            wanted, found = ("continuous", "discrete") if kind is Continuous else ("discrete", "continuous")
            raise InvalidSetting(
                f"{option} {field.name}={value} does something with {wanted} actions alone, and these are {found}; "
                "leave it out."
            )


def to_json(config: Any) -> dict[str, Any]:
    """A config as JSON's types, to be read again by ``from_json``.

    Raises:
        InvalidSetting: A field has a value that JSON has no type for, or one that no run and no report is read with.
    """
    try:
        return parse_json(json.dumps(dataclasses.asdict(config)))
    except (TypeError, ValueError) as error:
        raise InvalidSetting(
            f"the settings of {type(config).__qualname__} cannot be kept in JSON: {error}. A field can be a finite "
            "number, a word, True, False, None, a tuple or a config of these."
        ) from None


def from_json(kind: type[ConfigT], stored: Mapping[str, Any]) -> ConfigT:
    """The config that ``to_json`` wrote.

    Raises:
        InvalidSetting: A field is unknown, of another type, or missing without a default; or the config refuses it.
    """
    hints = _types(kind)
    names = {field.name for field in dataclasses.fields(typing.cast(Any, kind))}
    if unknown := sorted(set(stored) - names):
        raise InvalidSetting(f"{kind.__name__} has no field {', '.join(unknown)}; it was written by another version.")
    values = {}
    for name, value in stored.items():
        try:
            values[name] = decoded(hints[name], value)
        except ValueError:
            raise InvalidSetting(f"a stored {kind.__name__} cannot be read: {name} is {value!r}.") from None
    try:
        return kind(**values)
    except InvalidSetting:
        raise
    except Exception as error:  # of a stranger's model, which may refuse a value by any
        said = str(error).rstrip(".") or type(error).__name__
        raise InvalidSetting(f"a stored {kind.__name__} cannot be read: {said}.") from None


def decoded(hint: Any, value: Any) -> Any:
    """JSON's value as one of a field's type: tuples out of lists, members of an enumeration out of their values.

    Raises:
        ValueError: It can be none.
        InvalidSetting: It is a config, and a field of it cannot be read.
    """
    if hint is Any:
        return value
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _first(arguments, lambda one: decoded(one, value))
    if origin is typing.Literal:
        return _first(arguments, lambda one: one if _is_same(one, value) else _refuse(value))
    kind = origin or hint
    if kind is tuple and isinstance(value, list | tuple):
        return tuple(decoded(one, part) for one, part in zip(_of_parts(arguments, value), value, strict=True))
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return kind(value)
    if dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
        return from_json(typing.cast(Any, kind), value)
    if isinstance(value, bool) and kind in (int, float):
        return _refuse(value)
    fits = isinstance(value, int | float) if kind is float else not isinstance(kind, type) or isinstance(value, kind)
    return value if fits else _refuse(value)


def _of_parts(arguments: Sequence[Any], value: Sequence[Any]) -> Sequence[Any]:
    """The type of each part of a tuple that has such arguments; a bare one says nothing of them."""
    if not arguments:
        return [Any] * len(value)
    return [arguments[0]] * len(value) if arguments[1:] == (...,) else arguments


def _first(kinds: Sequence[Any], read: Callable[[Any], Any]) -> Any:
    """What the first of some types makes of a value."""
    for kind in kinds:
        with contextlib.suppress(ValueError, InvalidSetting):
            return read(kind)
    raise ValueError


def _is_same(choice: Any, value: Any) -> bool:
    return bool(choice == value) and isinstance(choice, bool) == isinstance(value, bool)


def _refuse(value: Any) -> NoReturn:
    raise ValueError(value)
