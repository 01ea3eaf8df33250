"""The order that people mean by numbered names: ``img2`` before ``img10``."""

from __future__ import annotations

import re


def natural(name: str) -> list[tuple[int, str]]:
    """A key to sort names by."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]
