"""The order that people mean by numbered names: ``img2`` before ``img10``, and ``0.25`` before ``0.5``.

The name of a picture that is a decimal number as a whole, such as ``1700000000.25.png``, counts as that number: a time.
In ``1.9`` and ``1.10`` the point stands between two whole numbers instead: a fraction is not written with a 0 at its
end, unless all fractions are written with the same number of digits, and then both readings give the same order.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

Key = list[tuple[int | Decimal, str]]
_DECIMAL: Final = re.compile(r"(\d+\.(\d+))(\.[^\W\d]\w*)?")  # with the suffix of a file


def in_natural_order(paths: Iterable[Path], *, may_be_times: bool = False) -> list[Path]:
    """Paths, sorted by their names.

    Args:
        paths: They.
        may_be_times: Whether a name may be a time with a fraction, as those of pictures are.
    """
    found = list(paths)
    are_decimals = may_be_times and _are_decimals([path.name for path in found])
    return sorted(found, key=lambda path: (natural(path.name, are_decimals=are_decimals), path.name))


def natural(name: str, *, are_decimals: bool = False) -> Key:
    """A key to sort names by.

    Args:
        name: Of a file or folder.
        are_decimals: Whether a name that looks like a decimal number is one.
    """
    decimal = _DECIMAL.fullmatch(name) if are_decimals else None
    if decimal is not None:
        return [(0, ""), (Decimal(decimal[1]), ""), (0, decimal[3] or "")]
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def _are_decimals(names: Sequence[str]) -> bool:
    """Whether the names that look like decimal numbers are some."""
    fractions = [found[2] for found in map(_DECIMAL.fullmatch, names) if found is not None]
    shortest = min(map(len, fractions), default=0)
    return all(len(fraction) == shortest or fraction[-1] != "0" for fraction in fractions)
