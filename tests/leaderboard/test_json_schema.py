from __future__ import annotations

from typing import Any

import pytest

from leaderboard.json_schema import Schema

CASES: list[tuple[dict[str, Any], list[Any], list[Any]]] = [
    ({"type": "integer", "minimum": 0}, [0, 7], [-1, 1.5, "1", True, None]),
    ({"type": ["number", "null"], "maximum": 2}, [1, 1.5, None], [3, "x", False]),
    ({"type": "boolean"}, [True], [1, "true"]),
    ({"const": 1}, [1], [True, 2]),
    ({"enum": ["a", "b"]}, ["a"], ["c", 1]),
    ({"type": "string", "pattern": "^[a-z]+$", "maxLength": 3, "minLength": 1}, ["abc"], ["abcd", "", "a1", "abc\n"]),
    (
        {"type": "array", "items": {"type": "integer"}, "minItems": 1, "maxItems": 2},
        [[1], [1, 2]],
        [[], [1, 2, 3], ["a"]],
    ),
    (
        {"type": "object", "required": ["a"], "properties": {"a": {"type": "integer"}}},
        [{"a": 1, "b": 2}],
        [{}, {"a": "x"}],
    ),
    ({"properties": {"a": {}}, "additionalProperties": False}, [{"a": 1}, {}], [{"b": 1}]),
    ({"additionalProperties": {"type": "string"}}, [{"b": "x"}], [{"b": 1}]),
    (
        {"type": "object", "propertyNames": {"pattern": "^[a-z]$"}, "maxProperties": 1},
        [{"a": 1}],
        [{"A": 1}, {"a": 1, "b": 2}],
    ),
    (
        {"if": {"properties": {"k": {"const": 1}}}, "then": {"required": ["a"]}, "else": {"required": ["b"]}},
        [{"k": 1, "a": 0}, {"k": 2, "b": 0}],
        [{"k": 1, "b": 0}, {"k": 2, "a": 0}],
    ),
    ({"$ref": "#/$defs/x", "$defs": {"x": {"type": "null"}}}, [None], [1]),
]


@pytest.mark.parametrize(("schema", "good", "bad"), CASES)
def test_what_each_keyword_lets_pass(schema: dict[str, Any], good: list[Any], bad: list[Any]) -> None:
    assert all(not Schema(schema).violations(value) for value in good)
    assert all(Schema(schema).violations(value) for value in bad)


def test_the_place_is_said() -> None:
    schema = {"properties": {"figures": {"additionalProperties": {"properties": {"mean": {"type": "number"}}}}}}

    (said,) = Schema(schema).violations({"figures": {"mse": {"mean": "low"}}})

    assert said == "figures.mse.mean is 'low', not of the type number"


def test_an_unknown_keyword_is_not_passed_over() -> None:
    with pytest.raises(ValueError, match="uniqueItems"):
        Schema({"uniqueItems": True})
