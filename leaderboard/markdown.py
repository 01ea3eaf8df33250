"""Markdown tables from untrusted text, which cannot break the page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

WIDTH: Final = 120
"""Characters of a line of words."""

_SPECIAL: Final = re.compile(r"([\\`*\[\]<>|~&])")


def plain(text: str) -> str:
    """A text that Markdown shows as it is, on one line."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 1) -> list[str]:
    """The lines of a table; the first ``words`` columns are aligned left, the others right.

    Args:
        head: The headings.
        rows: A cell for each heading, as Markdown.
        words: Columns of words.
    """
    rule = ["---"] * words + ["---:"] * (len(head) - words)
    return [f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |") for cells in (head, rule, *rows)]
