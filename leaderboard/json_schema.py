"""Checks a JSON value against a JSON Schema (draft 2020-12), as much of it as ``schema.json`` uses.

A keyword that is not known here is an error of the schema, not something to pass over. Two things are stricter than
the standard, both for the sake of a value from anybody: a ``pattern`` is one of the whole text, and 4.0 is no
integer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

KINDS: Mapping[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "boolean": (bool,),
    "null": (type(None),),
}
INFINITE = float("inf")
ANNOTATIONS = frozenset({"$schema", "$id", "$defs", "title", "description"})
OF_OBJECTS = frozenset({"properties", "required", "additionalProperties", "propertyNames", "maxProperties"})
KNOWN = ANNOTATIONS | {
    *("type", "const", "enum", "$ref", "if", "then", "else"),
    *("pattern", "minLength", "maxLength", "minimum", "maximum", "items", "minItems", "maxItems"),
    *OF_OBJECTS,
}


_Place = tuple[Any, ...]
"""Where a value stands: the place of what holds it, and its name or number there; empty for the whole."""

_Check = Callable[[Any, _Place, list[str]], None]
"""Appends what is wrong with a value."""


class Schema:
    """A schema, read once for any number of values.

    Args:
        rule: The schema.

    Raises:
        ValueError: It uses a keyword that is not known here.
    """

    def __init__(self, rule: Mapping[str, Any]) -> None:
        self._any = self._check({})
        self._definitions: dict[str, _Check] = {}
        for name, definition in rule.get("$defs", {}).items():
            self._definitions[name] = self._check(definition)
        self._whole = self._check(rule)

    def violations(self, value: object) -> list[str]:
        """Every way in which a value breaks the schema, each a sentence that begins with the place."""
        found: list[str] = []
        self._whole(value, (), found)
        return found

    def _check(self, rule: Mapping[str, Any]) -> _Check:
        unknown = set(rule) - KNOWN
        if unknown:
            raise ValueError(f"the schema uses {', '.join(sorted(unknown))}, which is not known here")
        wanted = rule.get("type")
        kinds = KINDS if wanted is None else [wanted] if isinstance(wanted, str) else wanted
        usual = {kind for name in kinds for kind in KINDS[name]}
        checks = [self._referred(rule["$ref"])] if "$ref" in rule else []
        checks += [of(rule) for applies, of in self._parts(set(kinds), set(rule)) if applies]

        def check(value: Any, place: _Place, found: list[str]) -> None:
            if type(value) not in usual and wanted is not None and not _is_kind(value, kinds):
                found.append(f"{_told(place)} is {_short(value)}, not of the type {_either(wanted)}")
                return
            for part in checks:
                part(value, place, found)

        return check

    def _parts(self, kinds: set[str], keywords: set[str]) -> list[tuple[bool, Callable[[Mapping[str, Any]], _Check]]]:
        """What makes the check of a rule for values of some kinds, and whether it has anything to say there."""
        return [
            (not keywords.isdisjoint({"const", "enum"}), _of_choice),
            ("string" in kinds, _of_text),
            (not kinds.isdisjoint({"number", "integer"}), _of_number),
            ("object" in kinds and not keywords.isdisjoint(OF_OBJECTS), self._of_object),
            ("array" in kinds, self._of_array),
            ("if" in keywords, self._of_condition),
        ]

    def _referred(self, reference: str) -> _Check:
        name = reference.removeprefix("#/$defs/")
        return lambda value, place, found: self._definitions[name](value, place, found)

    def _of_object(self, rule: Mapping[str, Any]) -> _Check:
        required, most = rule.get("required", ()), rule.get("maxProperties")
        known = {name: self._check(inner) for name, inner in rule.get("properties", {}).items()}
        others = rule.get("additionalProperties", True)
        of_names = self._check(rule["propertyNames"]) if "propertyNames" in rule else None
        of_others = None if isinstance(others, bool) else self._check(others)

        def check(value: Any, place: _Place, found: list[str]) -> None:
            if not isinstance(value, dict):
                return
            found += [f"{_told(place)} lacks {name!r}" for name in required if name not in value]
            if most is not None and len(value) > most:
                found.append(f"{_told(place)} has {len(value)} members, more than {most}")
                return
            for name, inner in value.items():
                if of_names is not None:
                    of_names(name, (place, None), found)
                of_it = known.get(name, of_others)
                if of_it is not None:
                    of_it(inner, (place, name), found)
                elif others is False:
                    found.append(f"{_told(place)} has {_short(name)}, which is not known")

        return check

    def _of_array(self, rule: Mapping[str, Any]) -> _Check:
        least, most = rule.get("minItems", 0), rule.get("maxItems", INFINITE)
        of_items = self._check(rule["items"]) if "items" in rule else self._of_anything

        def check(value: Any, place: _Place, found: list[str]) -> None:
            if not isinstance(value, list):
                return
            if not least <= len(value) <= most:
                found.append(f"{_told(place)} has {len(value)} items, too few or too many")
            else:
                for index, inner in enumerate(value):
                    of_items(inner, (place, index), found)

        return check

    def _of_anything(self, value: Any, place: _Place, found: list[str]) -> None:
        """Of what no rule speaks; a number or a text may still be none."""
        self._any(value, place, found)

    def _of_condition(self, rule: Mapping[str, Any]) -> _Check:
        condition = self._check(rule["if"])
        then, otherwise = (self._check(rule[word]) if word in rule else None for word in ("then", "else"))

        def check(value: Any, place: _Place, found: list[str]) -> None:
            broken: list[str] = []
            condition(value, place, broken)
            consequence = otherwise if broken else then
            if consequence is not None:
                consequence(value, place, found)

        return check


def _of_choice(rule: Mapping[str, Any]) -> _Check:
    def check(value: Any, place: _Place, found: list[str]) -> None:
        if "const" in rule and not _equal(value, rule["const"]):
            found.append(f"{_told(place)} is {_short(value)}, not {rule['const']!r}")
        if "enum" in rule and not any(_equal(value, one) for one in rule["enum"]):
            found.append(f"{_told(place)} is {_short(value)}, none of {', '.join(map(repr, rule['enum']))}")

    return check


def _of_text(rule: Mapping[str, Any]) -> _Check:
    least, most = rule.get("minLength", 0), rule.get("maxLength", INFINITE)
    pattern = re.compile(rule["pattern"].removeprefix("^").removesuffix("$")) if "pattern" in rule else None

    def check(value: Any, place: _Place, found: list[str]) -> None:
        if not isinstance(value, str):
            return
        if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
            found.append(f"{_told(place)} is {ascii(value)[:60]}, which is no text")
        elif not least <= len(value) <= most:
            found.append(f"{_told(place)} has {len(value)} characters; it can have {least} to {most}")
        elif pattern is not None and not pattern.fullmatch(value):
            found.append(f"{_told(place)} is {_short(value)}, which does not match {rule['pattern']}")

    return check


def _of_number(rule: Mapping[str, Any]) -> _Check:
    least, most = rule.get("minimum", -INFINITE), rule.get("maximum", INFINITE)

    def check(value: Any, place: _Place, found: list[str]) -> None:
        if isinstance(value, int | float) and not isinstance(value, bool) and not least <= value <= most:
            found.append(f"{_told(place)} is {value}, which cannot be")

    return check


def _told(place: _Place) -> str:
    """The place in words."""
    if not place:
        return "the entry"
    outer, name = _told(place[0]), place[1]
    if name is None:
        return f"a name in {outer}"
    return f"{outer}[{name}]" if isinstance(name, int) else _inside(outer, name)


def _is_kind(value: object, kinds: Iterable[str]) -> bool:
    if isinstance(value, bool):
        return "boolean" in kinds
    return any(isinstance(value, KINDS[kind]) for kind in kinds)


def _equal(value: object, other: object) -> bool:
    return value == other and isinstance(value, bool) == isinstance(other, bool)


def _inside(place: str, name: str) -> str:
    shown = name if re.fullmatch(r"[\w.\[\]%-]{1,60}", name) else _short(name)
    return shown if place == "the entry" else f"{place}.{shown}"


def _either(kinds: str | list[str]) -> str:
    return kinds if isinstance(kinds, str) else " or ".join(kinds)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
