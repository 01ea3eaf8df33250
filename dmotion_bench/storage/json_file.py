"""JSON out of files that may come from anybody: bounded before it is parsed, plain after it.

What is accepted can be printed, compared, copied and written again: the text is UTF-8 without lone surrogates, every
name stands once, a whole number fits in 64 bits, and nothing is nested deeper than ``DEEPEST``.
"""

from __future__ import annotations

import json
import math
import stat
from pathlib import Path
from typing import Any, Final

from dmotion_bench.wording import shown

LARGEST: Final = 16 * 2**20  # bytes of a file that are read
MOST_VALUES: Final = 2_000_000
"""A value takes up to some 200 bytes of memory however short it is in the file: ``{},`` has three bytes."""
DEEPEST: Final = 32
"""What walks through the content by recursion has room for far more."""
_WHOLE: Final = range(-(2**63), 2**64 + 1)
_EXACT: Final = range(-(2**53) + 1, 2**53)
_DIGITS: Final = 20  # of the numbers in it, with their sign


class JsonUnreadable(ValueError):
    """There is no JSON object that can be accepted; the text says why, to follow "cannot be read: "."""


def read_json(
    path: Path, *, largest: int = LARGEST, most_values: int = MOST_VALUES, nan: bool = False
) -> dict[str, Any]:
    """The object that a file holds.

    Args:
        path: The file.
        largest: A larger file is refused [bytes].
        most_values: So is one with more values than this.
        nan: Whether NaN and the infinities are accepted.

    Raises:
        OSError: The file cannot be read.
        JsonUnreadable: It is too large, or holds something else.
    """
    return parse_json(read_bounded(path, largest=largest), largest=largest, most_values=most_values, nan=nan)


def read_bounded(path: Path, *, largest: int = LARGEST) -> bytes:
    """What a file holds, at most ``largest`` bytes.

    Raises:
        OSError: The file cannot be read.
        JsonUnreadable: It is larger, or no ordinary file.
    """
    if not stat.S_ISREG(path.stat().st_mode):  # a pipe would be waited for
        raise JsonUnreadable("it is no ordinary file")
    with path.open("rb") as file:
        raw = file.read(largest + 1)
    _require_size(raw, largest)
    return raw


def parse_json(
    raw: bytes | str, *, largest: int = LARGEST, most_values: int = MOST_VALUES, nan: bool = False
) -> dict[str, Any]:
    """The object that a text stands for; arguments and errors as those of ``read_json``.

    Raises:
        JsonUnreadable: It is too large, or stands for something else.
    """
    content = parse_value(raw, largest=largest, most_values=most_values, nan=nan)
    if not isinstance(content, dict):
        raise JsonUnreadable(f"it holds {shown(content)}, not a JSON object")
    return content


def parse_value(
    raw: bytes | str,
    *,
    largest: int = LARGEST,
    most_values: int = MOST_VALUES,
    nan: bool = False,
    exact: bool = False,
) -> Any:
    """What a text stands for, an object or not.

    Args:
        raw: The text.
        largest, most_values, nan: As of ``read_json``.
        exact: Whether whole numbers that floating point cannot hold exactly are refused.

    Raises:
        JsonUnreadable: It is too large, or no JSON that is accepted.
    """
    _require_size(raw, largest)
    try:
        text = raw.decode() if isinstance(raw, bytes) else raw
    except UnicodeDecodeError as error:
        raise JsonUnreadable(f"byte {error.start} is not UTF-8 text") from None
    if sum(text.count(mark) for mark in ",[{") > most_values:
        raise JsonUnreadable(f"it holds more than {most_values:,} values")
    real, constant = (float, float) if nan else (_finite, _finite)
    try:
        content = json.loads(
            text,
            object_pairs_hook=_unique,
            parse_int=_exact if exact else _whole,
            parse_float=real,
            parse_constant=constant,
        )
    except RecursionError:
        raise JsonUnreadable(f"it is nested deeper than {DEEPEST} levels") from None
    except json.JSONDecodeError as error:
        raise JsonUnreadable(f"it is no JSON: {error}") from None
    _check_plain(content)
    return content


def _require_size(raw: bytes | str, largest: int) -> None:
    if len(raw) > largest:
        raise JsonUnreadable(f"it is larger than {largest:,} bytes")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise JsonUnreadable("it names something twice")
    return content


def _whole(text: str) -> int:
    if len(text) > _DIGITS or int(text) not in _WHOLE:
        raise JsonUnreadable(f"it holds the whole number {shown(text)}, which does not fit in 64 bits")
    return int(text)


def _exact(text: str) -> int:
    value = _whole(text)
    if value not in _EXACT:
        raise JsonUnreadable(f"it holds the whole number {shown(text)}, which floating point cannot hold exactly")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise JsonUnreadable(f"it holds the number {shown(text)}, which is not finite")
    return value


def _check_plain(content: object) -> None:
    """Level by level, so that no depth is too much for the check itself."""
    level: list[Any] = [content]
    for _ in range(DEEPEST):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                inner += value
                inner += value.values()
            elif isinstance(value, list):
                inner += value
            elif isinstance(value, str):
                _check_text(value)
        level = inner
    if level:
        raise JsonUnreadable(f"it is nested deeper than {DEEPEST} levels")


def _check_text(text: str) -> None:
    if not text.isascii():
        try:
            text.encode()
        except UnicodeEncodeError:
            raise JsonUnreadable(f"it holds the text {shown(text)}, half a character of UTF-16") from None
