"""Taking a JSON object apart, field by field, into values of known kinds."""

from __future__ import annotations

from typing import Any

from dmotion_bench.wording import shown


class Fields:
    """The fields of an object.

    Every method raises ``ValueError`` where the field is missing or of another kind, and says which one.

    Args:
        value: What was read.
        where: What it is called in sentences: ``"recipe"``.
    """

    def __init__(self, value: object, where: str) -> None:
        if not isinstance(value, dict):
            raise ValueError(f"{where} is {shown(value)}, not an object")  # noqa: TRY004 (a file's fault, not a caller's)
        self._value, self._where = value, where

    def _take(self, name: str, *kinds: type) -> Any:
        value = self._value.get(name)
        if type(value) not in kinds:  # True is an int to isinstance
            raise ValueError(f"{self._where}.{name} is {shown(value)}")
        return value

    def text(self, name: str) -> str:
        """A string."""
        return str(self._take(name, str))

    def truth(self, name: str) -> bool:
        """True or false."""
        return bool(self._take(name, bool))

    def real(self, name: str) -> float:
        """A number."""
        return float(self._take(name, int, float))

    def real_or_none(self, name: str) -> float | None:
        """A number, or null."""
        return None if self._value.get(name, ...) is None else self.real(name)

    def whole(self, name: str) -> int:
        """A whole number."""
        return int(self._take(name, int))

    def whole_or_none(self, name: str) -> int | None:
        """A whole number, or null."""
        return None if self._value.get(name, ...) is None else self.whole(name)

    def wholes(self, name: str, count: int) -> tuple[int, ...]:
        """An array of so many whole numbers."""
        values = self.many(name)
        if len(values) != count or not all(type(value) is int for value in values):
            raise ValueError(f"{self._where}.{name} is {shown(values)}, not {count} whole numbers")
        return tuple(values)

    def value(self, name: str) -> object:
        """Whatever is there, None if nothing is."""
        return self._value.get(name)

    def many(self, name: str) -> list[Any]:
        """An array."""
        return list(self._take(name, list))

    def pairs(self, name: str) -> dict[str, Any]:
        """An object, as it is."""
        return dict(self._take(name, dict))

    def inner(self, name: str) -> Fields:
        """An object, to be taken apart in turn."""
        return Fields(self._value.get(name), f"{self._where}.{name}")

    def inner_or_none(self, name: str) -> Fields | None:
        """An object, or null."""
        return None if self._value.get(name, ...) is None else self.inner(name)

    def texts(self, name: str) -> tuple[str, ...]:
        """An array of strings."""
        values = self.many(name)
        if not all(type(value) is str for value in values):
            raise ValueError(f"{self._where}.{name} is {shown(values)}, not all of them text")
        return tuple(values)
