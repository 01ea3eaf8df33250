"""Any JSON is accepted and plain, or refused in a sentence."""

from __future__ import annotations

import contextlib
import json
import os
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.storage.json_file import DEEPEST, JsonUnreadable, parse_json, read_json


def nested(levels: int) -> str:
    """Levels of arrays within an object."""
    return '{"a": ' + "[" * levels + "]" * levels + "}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1]", "not a JSON object"),
        ("{", "no JSON"),
        ("", "no JSON"),
        (b'{"a": "\xff"}', "byte 7 is not UTF-8"),
        ("{}".encode("utf-16"), "not UTF-8"),
        (r'{"a": "\ud800"}', "half a character"),
        (r'{"\udfff": 1}', "half a character"),
        (r'{"a": ["b", {"c": "x\udc00"}]}', "half a character"),
        ('{"a": 1, "a": 1}', "twice"),
        ('{"a": ' + "9" * 5000 + "}", "64 bits"),
        ('{"a": 36893488147419103232}', "64 bits"),
        ('{"a": 1e999}', "not finite"),
        ('{"a": NaN}', "not finite"),
        (nested(DEEPEST), "nested deeper"),
        (nested(100_000), "nested deeper"),
        ('{"a":' * 100_000, "nested deeper"),
        ('{"a": [' + "{}," * 2_000_000 + "0]}", "more than 2,000,000 values"),
        (b" " * (16 * 2**20 + 1), "larger than"),
    ],
)
def test_what_is_no_plain_object_is_refused_shortly(text: bytes | str, said: str) -> None:
    with pytest.raises(JsonUnreadable, match=said) as caught:
        parse_json(text)
    assert len(str(caught.value)) < 400


def test_what_is_plain_is_read(tmp_path: Path) -> None:
    content = {"a": [1, -(2**63), 2**64, 0.5, "é😀\u2028", None, True], "b": {"c": {}}}
    (tmp_path / "a.json").write_text(json.dumps(content))  # the emoji as a pair of surrogates
    assert read_json(tmp_path / "a.json") == content
    assert parse_json(nested(DEEPEST - 2))
    assert parse_json('{"a": NaN, "b": Infinity}', nan=True)["b"] == float("inf")


def test_what_is_no_ordinary_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(JsonUnreadable, match="no ordinary file"):
            read_json(path)
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "nowhere")


def test_the_shortest_values_take_bounded_memory() -> None:
    for part in ("[],", "{},", '{"a":0},', '"\u0101b",', "1.5,"):
        text = '{"a": [' + part * (16 * 2**20 // len(part.encode()) - 10) + "0]}"
        tracemalloc.start()
        with contextlib.suppress(JsonUnreadable):
            parse_json(text)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 500 * 2**20, part


ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(exclude_categories=()), max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(st.characters(exclude_categories=()), max_size=5), inner, max_size=3)
    ),
)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=200)
@given(content=ANY)
def test_whatever_is_accepted_can_be_written_again(content: object) -> None:
    try:
        read = parse_json(json.dumps(content))
    except JsonUnreadable as error:
        str(error).encode()
    else:
        assert read == content
        json.dumps(read, ensure_ascii=False, allow_nan=False).encode()
