"""Checks a JSON value against a JSON Schema (draft 2020-12), as much of it as ``schema.json`` uses.

A keyword that is not known here is an error of the schema, not something to pass over. Two things are stricter than
the standard, both for the sake of a value from anybody: a ``pattern`` is one of the whole text, and 4.0 is no
integer.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
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
KNOWN = ANNOTATIONS | {
    *("type", "const", "enum", "$ref", "if", "then", "else"),
    *("pattern", "minLength", "maxLength", "minimum", "maximum", "items", "minItems", "maxItems"),
    *("properties", "required", "additionalProperties", "propertyNames", "maxProperties"),
}


def violations(value: object, schema: Mapping[str, Any]) -> list[str]:
    """Every way in which a value breaks a schema, each a sentence that begins with the place."""
    return list(_violations(value, schema, schema, "the entry"))


def _violations(value: Any, rule: Mapping[str, Any], root: Mapping[str, Any], place: str) -> Iterator[str]:
    unknown = set(rule) - KNOWN
    if unknown:
        raise ValueError(f"the schema uses {', '.join(sorted(unknown))}, which is not known here")
    if "$ref" in rule:
        yield from _violations(value, root["$defs"][rule["$ref"].removeprefix("#/$defs/")], root, place)
    if "type" in rule and not _is_kind(value, rule["type"]):
        yield f"{place} is {_short(value)}, not of the type {_either(rule['type'])}"
        return
    if "const" in rule and not _equal(value, rule["const"]):
        yield f"{place} is {_short(value)}, not {rule['const']!r}"
    if "enum" in rule and not any(_equal(value, one) for one in rule["enum"]):
        yield f"{place} is {_short(value)}, none of {', '.join(map(repr, rule['enum']))}"
    if isinstance(value, str):
        yield from _of_text(value, rule, place)
    elif isinstance(value, dict):
        yield from _of_object(value, rule, root, place)
    elif isinstance(value, list):
        yield from _of_array(value, rule, root, place)
    elif _is_kind(value, "number") and not rule.get("minimum", -INFINITE) <= value <= rule.get("maximum", INFINITE):
        yield f"{place} is {value}, which cannot be"
    if "if" in rule:
        holds = not any(_violations(value, rule["if"], root, place))
        yield from _violations(value, rule.get("then" if holds else "else", {}), root, place)


def _of_text(value: str, rule: Mapping[str, Any], place: str) -> Iterator[str]:
    if any("\ud800" <= letter <= "\udfff" for letter in value):
        yield f"{place} is {ascii(value)[:60]}, which is no text"
        return
    if not rule.get("minLength", 0) <= len(value) <= rule.get("maxLength", len(value)):
        yield f"{place} has {len(value)} characters; it can have {rule.get('minLength', 0)} to {rule['maxLength']}"
    elif "pattern" in rule and not re.fullmatch(rule["pattern"].removeprefix("^").removesuffix("$"), value):
        yield f"{place} is {_short(value)}, which does not match {rule['pattern']}"


def _of_object(value: Mapping[str, Any], rule: Mapping[str, Any], root: Mapping[str, Any], place: str) -> Iterator[str]:
    for name in rule.get("required", ()):
        if name not in value:
            yield f"{place} lacks {name!r}"
    if len(value) > rule.get("maxProperties", len(value)):
        yield f"{place} has {len(value)} members, more than {rule['maxProperties']}"
        return
    known = rule.get("properties", {})
    for name, inner in value.items():
        if "propertyNames" in rule:
            yield from _violations(name, rule["propertyNames"], root, f"a name in {place}")
        others = rule.get("additionalProperties", True)
        if name in known:
            yield from _violations(inner, known[name], root, _inside(place, name))
        elif others is False:
            yield f"{place} has {_short(name)}, which is not known"
        elif others is not True:
            yield from _violations(inner, others, root, _inside(place, name))


def _of_array(value: list[Any], rule: Mapping[str, Any], root: Mapping[str, Any], place: str) -> Iterator[str]:
    if not rule.get("minItems", 0) <= len(value) <= rule.get("maxItems", len(value)):
        yield f"{place} has {len(value)} items, too few or too many"
        return
    for index, inner in enumerate(value):
        yield from _violations(inner, rule.get("items", {}), root, f"{place}[{index}]")


def _is_kind(value: object, wanted: str | list[str]) -> bool:
    kinds = [wanted] if isinstance(wanted, str) else wanted
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
