"""From a Gymnasium id to a class that can be recorded.

An id is found in Gymnasium's registry, after the package that registers it has been imported: Gymnasium's own, those of
``worlds.SOURCES``, and any other by ``MODULE:ID`` (``modules.py``).
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import re
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final

import gymnasium

from dmotion_bench.environment import Environment, Tier
from dmotion_bench.errors import InvalidSetting, PackageNotInstalled, UnknownName, UsageError
from dmotion_bench.specs import Scalar
from dmotion_bench.wording import shown
from recorders.gymnasium_env.environment import GymnasiumEnvironment
from recorders.gymnasium_env.guest import quiet, unmade
from recorders.gymnasium_env.modules import import_named, owners_of
from recorders.gymnasium_env.worlds import PACKAGES, SOURCES, WORLDS, extra_for

_PLAIN: Final = (bool, int, float, str)
_OWN: Final[Mapping[str, Any]] = {
    "frame_size": int,
    "action_repeat": int,
    "max_episode_steps": int | None,
    "wrappers": str,
    "fresh": bool,
}
_NOT_SET: Final = ("self", "render_mode", "id", "disable_env_checker")


class GymnasiumFamily:
    """The members of ``gym``."""

    tier = Tier.PIXELS
    recording = GymnasiumEnvironment.recording
    policies = tuple(GymnasiumEnvironment.policies)

    def member(self, name: str) -> type[Environment]:
        """The class of an id.

        Raises:
            UnknownName: Gymnasium knows no such id.
            PackageNotInstalled: The id's package is absent.
            UsageError: The id names a module that is not imported.
        """
        return _member(name)

    def worlds(self) -> Mapping[str, str]:
        """The ids that are known to work."""
        return {name: f"{world.what} (dmbench[{world.extra}])" for name, world in WORLDS.items()}


FAMILY: Final = GymnasiumFamily()


@cache
def _member(name: str) -> type[Environment]:
    spec = _registered(name)
    module, colon, _ = name.rpartition(":")
    owners = owners_of(module, f"gym:{name}") if colon else ()

    class Member(GymnasiumEnvironment):
        """A Gymnasium environment of the tier ``pixels``."""

        id = name
        registered = spec.id
        packages = tuple(dict.fromkeys((*PACKAGES, *owners)))

        @classmethod
        def parameters(cls) -> tuple[Mapping[str, Any], bool]:
            """dmbench's own, then those of the environment's constructor."""
            theirs, more = _parameters(_creator(name, spec))
            return {**_OWN, **{key: kind for key, kind in theirs.items() if key not in _OWN}}, more

        @classmethod
        def completed(cls, parameters: Mapping[str, Scalar]) -> dict[str, Scalar]:
            """With size, repetition and time limit, so that another version of Gymnasium records the same."""
            usual: dict[str, Scalar] = {"frame_size": 128, "action_repeat": 1, "fresh": True}
            if spec.max_episode_steps is not None:
                usual["max_episode_steps"] = spec.max_episode_steps
            return dict(sorted({**usual, **parameters}.items()))

    Member.__name__ = Member.__qualname__ = "GymnasiumEnvironment"
    return Member


def _registered(name: str) -> Any:
    """Gymnasium's entry of an id."""
    module, colon, plain = name.rpartition(":")
    source = next((one for start, one in SOURCES.items() if name.startswith(start)), None)
    if colon:
        import_named(module, f"gym:{name}")
    elif source is not None and name not in gymnasium.registry:
        try:
            with quiet():
                importlib.import_module(source.module)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] != source.module:
                raise unmade(f"gym:{name}", error) from error
            raise PackageNotInstalled(
                source.package, f"'gym:{name}'", f"pip install 'dmbench[{extra_for(name)}]'"
            ) from None
        except Exception as error:  # somebody else's module may raise anything
            raise unmade(f"gym:{name}", error) from error
    if plain not in gymnasium.registry:
        raise _unknown(plain)
    return gymnasium.registry[plain]


def _unknown(name: str) -> UsageError:
    """The error for an id that is not registered, with the closest one."""
    ids = sorted({*gymnasium.registry, *WORLDS})
    stem = re.sub(r"-v\d+$", "", name)
    near = [one for one in ids if re.sub(r"-v\d+$", "", one) == stem] or difflib.get_close_matches(name, ids, n=1)
    if near:
        return UnknownName("Gymnasium environment", name, [near[-1]], "dmbench list environments")
    return UsageError(
        f"no Gymnasium environment named {shown(name)}; 'dmbench list environments' lists some that are known to work. "
        "One that another package registers is named with its module: gym:MODULE:ID."
    )


def _creator(name: str, spec: Any) -> Callable[..., Any]:
    """What Gymnasium calls to make an environment."""
    try:
        with quiet():
            creator: Any = spec.entry_point
            if isinstance(creator, str):
                module, _, attribute = creator.partition(":")
                creator = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # somebody else's module may raise anything
        raise unmade(f"gym:{name}", error) from error
    if not callable(creator):
        raise InvalidSetting(f"'gym:{name}' is registered without anything that makes it.")
    made: Callable[..., Any] = creator
    return made


def _parameters(creator: Callable[..., Any]) -> tuple[Mapping[str, Any], bool]:
    """The plain parameters of a constructor and, where it hands others on, of those that it inherits from."""
    kinds: list[Any] = list(creator.__mro__) if inspect.isclass(creator) else [creator]
    found: dict[str, Any] = {}
    for kind in kinds:
        call = kind.__dict__.get("__init__") if inspect.isclass(kind) else kind
        if call is None or kind is object:
            continue
        try:
            signature = inspect.signature(call)
        except (TypeError, ValueError):
            return found, True
        hints = _hints(call)
        for key, one in signature.parameters.items():
            if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY) and key not in _NOT_SET and key not in found:
                wanted = _plain(hints.get(key), one.default)
                if wanted is not None:
                    found[key] = wanted
        if not any(one.kind is one.VAR_KEYWORD for one in signature.parameters.values()):
            return found, False
    return found, not inspect.isclass(creator)


def _hints(call: Any) -> Mapping[str, Any]:
    try:
        return typing.get_type_hints(call)
    except Exception:  # a type that cannot be resolved here
        return {}


def _plain(hint: Any, default: Any) -> Any:
    """The type that a parameter's text is read as; None if it is nothing that a text can say."""
    if hint in _PLAIN or typing.get_origin(hint) is typing.Literal:
        return hint
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [one for one in typing.get_args(hint) if one in _PLAIN]
        return Any if len(kinds) > 1 else (kinds[0] | None if kinds else None)
    if hint is None or hint is Any:
        return type(default) if type(default) in _PLAIN else Any if default in (None, inspect.Parameter.empty) else None
    return None
