"""JSON: values of other types, huge numbers, missing and doubled keys, deep nesting, text that is no Unicode."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.plain import spoil_bytes

MARKUP = "<img src=x onerror=dmbenchfuzz>"
"""Must never stand like this in a page that is made of an entry."""

_RAW = "\x00raw:"
_MARKED = re.compile(r'"\\u0000raw:((?:[^"\\]|\\(?!u0000).)*)\\u0000"')


def raw(text: str) -> str:
    """A value that is written as it stands, whatever it is, and not as JSON would have it."""
    return f"{_RAW}{text}\x00"


HOSTILE: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 7, 255, 256, 2**16, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63, 2**64, -(2**63)),
    *(10**9, 10**12, 10**18, 10**400, -(10**400), 0.0, -0.0, 0.5, 1e-320, 1e308, -1e308),
    *(raw("NaN"), raw("Infinity"), raw("-Infinity"), raw("1e999"), raw("9" * 5000), raw("1" + "0" * 4000)),
    *(raw("[" * 100_000 + "]" * 100_000), raw('{"a":' * 50_000 + "1" + "}" * 50_000), raw("[" * 900 + "]" * 900)),
    *("", " ", "a", "none", "true", "0", "-1", "1e400", "NaN", "x" * 300, "x" * 1_000_000, "\n" * 5, "\x1b[2J\x07"),
    *(raw('"\\ud800"'), raw('"\\udfff\\ud800x"'), "\x00", "a\x00b", "é" * 50, "\u202e\u2028", "%s%n{}{0.__class__}"),
    *("../../../etc/passwd", "/etc/passwd", "/", ".", "..", "~", "CON", MARKUP, f'"{MARKUP}', f"</script>{MARKUP}"),
    *("0" * 64, "f" * 64, "2024-01-01", "all", "100%", "one-shot", "9999999-shot", "-5-shot", "nan%", "1e9%"),
    *([], {}, [[]], [{}], {"": {}}, [None], [0] * 3, ["x"], {"a": 1}, [1e308, 1e308], ["a", 1, None, {}]),
    *(list(range(2000)), [0] * 200_000, {str(n): n for n in range(5000)}),
)


def spoil_json(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """Change the value in one to three places; sometimes the text."""
    if rng.random() < 0.15:
        return _spoil_text(rng, data)
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return spoil_bytes(rng, data)
    holder = {"": content}
    told = [_edit(rng, holder) for _ in range(int(rng.choice([1, 1, 1, 2, 3])))]
    try:
        text = written(holder[""], indent=2 if b"\n " in data else None)
    except (ValueError, RecursionError):  # something was put into itself
        return _spoil_text(rng, data)
    return text.encode("utf-8", "surrogatepass"), "; ".join(told)


def spoil_lines(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """JSON Lines: one of the lines as above, or the lines among themselves."""
    lines = data.split(b"\n")
    place = int(rng.integers(len(lines)))
    kind = pick(rng, ("edit", "edit", "edit", "edit", "repeat", "drop", "swap", "blank", "bytes"))
    if kind == "edit":
        lines[place], told = spoil_json(rng, lines[place])
        return b"\n".join(lines), f"line {place}: {told}"
    if kind == "repeat":
        lines[place : place + 1] = [lines[place]] * int(rng.choice([2, 100]))
    elif kind == "drop":
        del lines[place]
    elif kind == "swap":
        other = int(rng.integers(len(lines)))
        lines[place], lines[other] = lines[other], lines[place]
    elif kind == "blank":
        lines[place] = pick(rng, (b"", b"null", b"[]", b"1", b'"a"', b"{}", b"\xff\xfe", b"{"))
    else:
        return spoil_bytes(rng, data)
    return b"\n".join(lines), f"lines: {kind}"


def written(content: Any, indent: int | None = None) -> str:
    """JSON with what ``raw`` marked put in as it is; a mark that a later change has cut is a text like any other."""
    return _MARKED.sub(lambda found: json.loads(f'"{found[1]}"'), json.dumps(content, indent=indent))


def _edit(rng: np.random.Generator, root: dict[str, Any]) -> str:
    path, holder, key = _place(rng, root)
    value = holder[key]
    where = ".".join(map(str, path)) or "(all)"
    kind = pick(rng, ("hostile",) * 5 + ("near",) * 4 + ("drop", "rename", "add", "wrap", "swap", "twice"))
    if kind == "near" and not isinstance(value, dict | list | type(None)):
        holder[key] = _near(rng, value)
        return f"{where} is {holder[key]!r:.60}"
    if kind == "drop" and len(path):
        del holder[key]
        return f"{where} is gone"
    if kind == "rename" and isinstance(holder, dict) and path:
        holder[pick(rng, (f"{key}_", key.upper(), "", "__class__", "x" * 100_000, raw('"\\ud800"')))] = holder.pop(key)
        return f"{where} has another name"
    if kind == "add" and isinstance(value, dict):
        value[pick(rng, ("new", "", "__proto__", "\x1b[31m", "y" * 5000, "0"))] = pick(rng, HOSTILE)
        return f"{where} has one key more"
    if kind == "add" and isinstance(value, list):
        value.insert(int(rng.integers(len(value) + 1)), pick(rng, [*HOSTILE, *value]))
        return f"{where} has one value more"
    if kind == "wrap":
        holder[key] = pick(rng, ([value], {"a": value}, [value] * 2, [value] * 3, str(value)[:1000]))
        return f"{where} is wrapped"
    if kind == "swap":
        _, other, name = _place(rng, root)
        holder[key], other[name] = other[name], holder[key]
        return f"{where} is swapped with {name}"
    if kind == "twice" and isinstance(holder, dict) and path:
        text = json.dumps(value)[:100_000]
        text = "1" if "raw:" in text else text
        holder[key] = raw(f"{text}, {json.dumps(key)}: {json.dumps(pick(rng, (None, 0, '', value)))}")
        return f"{where} is there twice"
    holder[key] = pick(rng, HOSTILE)
    return f"{where} is {holder[key]!r:.60}"


def _near(rng: np.random.Generator, value: Any) -> Any:
    """Another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return pick(
            rng,
            (
                value + 1,
                value - 1,
                -value,
                value * 2,
                value * 1000,
                value // 2,
                float(value) if abs(value) < 2**60 else 0.5,
                f"{value:x}",
            ),
        )
    if isinstance(value, float):
        return pick(
            rng, (-value, value * 2, value * 1e6, value + 1e-9, int(value) if abs(value) < 1e300 else 0, str(value))
        )
    at = int(rng.integers(len(value) + 1))
    return pick(
        rng, (value[:at], value[:at] + "x" + value[at:], value[::-1], value * 2, value.upper(), f" {value}", value[1:])
    )


def _place(rng: np.random.Generator, root: dict[str, Any]) -> tuple[tuple[Any, ...], Any, Any]:
    """Any value, with what holds it and under which key."""
    places = list(_walk((), root))
    return places[int(rng.integers(len(places)))]


def _walk(path: tuple[Any, ...], holder: Any) -> Iterator[tuple[tuple[Any, ...], Any, Any]]:
    keys = list(holder) if isinstance(holder, dict) else range(min(len(holder), 8))
    for key in keys:
        here = (*path, key) if key != "" or path else ()
        yield here, holder, key
        if isinstance(holder[key], dict | list) and len(path) < 12:
            yield from _walk(here or ("",), holder[key])


def _spoil_text(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    kind = pick(rng, ("bom", "utf-16", "latin", "tail", "nested", "digits", "comment", "empty", "null", "cut", "cut"))
    at = int(rng.integers(len(data) + 1))
    spoilt = {
        "bom": b"\xef\xbb\xbf" + data,
        "utf-16": data.decode("utf-8", "replace").encode("utf-16"),
        "latin": data[:at] + b"\xe9\xff" + data[at:],
        "tail": data + pick(rng, (b"{}", b"\x00", b"]", b"\n\n//")),
        "nested": pick(rng, (b"[" * 100_000, b'{"a":' * 100_000, b"[" * 100_000 + b"]" * 100_000)),
        "digits": b"9" * 5000,
        "comment": data.replace(b"{", b"{/* */", 1),
        "empty": b"",
        "null": pick(rng, (b"null", b"[]", b"{}", b"0", b'""', b"true", b"NaN")),
        "cut": data[:at],
    }[kind]
    return spoilt, f"text: {kind}"
