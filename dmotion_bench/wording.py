"""Names, values, numbers and commands for use in messages: shortened, printable, ready to paste into a shell."""

from __future__ import annotations

import math
import os
import re
import shlex
from collections.abc import Callable
from typing import Final

VALUE_LIMIT: Final = 120
SENTENCE_LIMIT: Final = 4000
"""Characters. A sentence may hold a long path twice; a value out of a file has no such reason."""
_UNPRINTABLE: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def shortened(text: str, limit: int) -> str:
    """The text, or its beginning and end with the number of characters left out between them."""
    if len(text) <= limit:
        return text
    head = limit * 2 // 3
    tail = limit - head
    return f"{text[:head]}... [{len(text) - limit} characters] ...{text[-tail:]}"


def shown(value: object) -> str:
    """A value that somebody gave, as Python writes it, for a sentence: ``'cwsm'``."""
    if isinstance(value, str):
        return shortened(repr(shortened(value, VALUE_LIMIT)), 2 * VALUE_LIMIT)
    try:
        return shortened(repr(value), VALUE_LIMIT)
    except (ValueError, RecursionError):  # a whole number of thousands of digits, something nested too deeply
        return f"a {type(value).__name__} too large to show"
    except Exception:  # a stranger's object may raise anything
        return f"a {type(value).__name__}"


def sentence(text: str) -> str:
    """A whole sentence that is safe to print: of bounded length, without control characters or lone surrogates."""
    return printable(shortened(text, SENTENCE_LIMIT))


def printable(text: str) -> str:
    """A text without what a terminal takes as an order, such as the names of other people's folders may hold."""
    return _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)


def rounded(value: float | None) -> str:
    """A figure with three significant digits and without an exponent, thousands set apart; empty for None.

    Every figure for readers is written by this rule: in the terminal, in Rerun, on the page and in the documents. Below
    1e-4 it is zero: no figure of this benchmark is told apart there.
    """
    if value is None:
        return ""
    if not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < 1e-4:
        return "0"
    exponent = int(f"{value:.2e}".partition("e")[2])
    return f"{value:,.{max(0, 2 - exponent)}f}"


def from_to(
    low: float | None, high: float | None, *, number: Callable[[float], str] = rounded, to: str = " to "
) -> str:
    """An interval as text: ``0.12 to 0.34``, or ``0.12 or more`` where its upper end is infinite.

    Args:
        low, high: Its ends; None of an interval that does not exist, whose text is empty.
        number: Writes one of them.
        to: Stands between them.
    """
    if low is None or high is None:
        return ""
    return f"{number(low)} or more" if high == math.inf else f"{number(low)}{to}{number(high)}"


def duration(seconds: float) -> str:
    """A time with three significant digits, or whole seconds, as people read it: ``0.533 s``, ``2 s``, ``3,600 s``."""
    is_short = 0 < abs(seconds) < 1e-3
    figure = rounded(seconds * 1e6 if is_short else seconds)
    return f"{figure.rstrip('0').rstrip('.') if '.' in figure else figure} {'µs' if is_short else 's'}"


def durations(least: float, most: float) -> str:
    """Times from the least to the most: ``0.5 to 2 s``, or one of them if both are written the same."""
    first, last = duration(least), duration(most)
    if first == last:
        return first
    unit = last[last.index(" ") :]
    return f"{first.removesuffix(unit)} to {last}"


def counted(count: int, what: str) -> str:
    """A number of things, such as ``1 step`` and ``2 steps``."""
    return f"{count:,} {what}" + ("" if count == 1 else "s")


def command(start: str, *words: str | os.PathLike[str]) -> str:
    """A command to type next, in quotation marks.

    The outer marks are some that the command does not hold: ``'dmbench data check data/a'`` but
    ``"dmbench data check 'my data'"``.

    Args:
        start: How it begins, as it is typed: ``"dmbench data check"``.
        words: What follows; each is quoted where a shell needs that.
    """
    text = " ".join([start, *(shlex.quote(os.fspath(word)) for word in words)])
    mark = next((mark for mark in ("'", '"') if mark not in text), "`")
    return f"{mark}{text}{mark}"
