"""Markdown tables from untrusted text, which cannot break the page."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from typing import Final

WIDTH: Final = 120
"""Characters of a line of words."""

_SPECIAL: Final = re.compile(r"([\\`*\[\]<>|~&])")
_OPENING: Final = re.compile(r"^(?:(?=#{1,6}(?:\s|$)|[+-](?:\s|$)|[=_\s-]+$)|(\d{1,9})(?=[.)](?:\s|$)))")
"""Where a line needs a backslash so that it begins no heading, list or rule: at its start, or behind a number."""


def plain(text: str) -> str:
    """A text that Markdown shows as it is, on one line."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))


def paragraph(text: str) -> list[str]:
    """The lines of an untrusted text as one paragraph: none of them begins a heading, a list or a rule."""
    return [_OPENING.sub(r"\1\\", line) for line in textwrap.wrap(plain(text), WIDTH)]


def code(text: str) -> str:
    """A text as code, on one line, between more backticks than it has in a row."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    pad = " " if len(fence) > 1 else ""
    return f"{fence}{pad}{' '.join(text.split())}{pad}{fence}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 1) -> list[str]:
    """The lines of a table; the first ``words`` columns are aligned left, the others right.

    Args:
        head: The headings.
        rows: A cell for each heading, as Markdown.
        words: Columns of words.
    """
    rule = ["---"] * words + ["---:"] * (len(head) - words)
    return [f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |") for cells in (head, rule, *rows)]
