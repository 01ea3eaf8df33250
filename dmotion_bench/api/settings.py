"""Settings as Python writes them, ``{"epochs": 5}``, as the texts that the command line takes, ``epochs=5``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import Preset, SplitName
from dmotion_bench.wording import shown

Settings = Mapping[str, object] | Sequence[str] | None
"""Settings by name, or ``KEY=VALUE`` texts."""

DEVICES: Final = ("auto", "cpu", "cuda")
SPLITS: Final[tuple[SplitName, ...]] = ("train", "validation", "test")
SPLIT_PROTOCOLS: Final = ("episode", "paper")
TRACKERS: Final = ("tensorboard", "wandb")


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
    return tuple(settings)


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
