"""The order that people mean by numbered names: ``img2`` before ``img10``, and ``0.25`` before ``0.5``.

The name of a picture that is a decimal number as a whole, such as ``1700000000.25.png``, counts as that number: a time.
In ``1.9`` and ``1.10`` the point stands between two whole numbers instead: a fraction is not written with a 0 at its
end, unless all fractions are written with the same number of digits, and then both readings give the same order. ROS
counts seconds and nanoseconds: where somebody has joined the two, ``1700000000.4567.png`` is 4,567 ns after a second.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from dmotion_bench.storage.imports.timeline import irregularity

Key = list[tuple[int | Decimal, str]]
_SINCE_1970, _NANO = 10, 9  # digits of whole seconds, and of nanoseconds
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
    found = [decimal for decimal in map(_DECIMAL.fullmatch, names) if decimal is not None]
    fractions = [decimal[2] for decimal in found]
    shortest = min(map(len, fractions), default=0)
    may_be = all(len(fraction) == shortest or fraction[-1] != "0" for fraction in fractions)
    return may_be and not _are_seconds_and_nanoseconds([decimal[1] for decimal in found])


def _are_seconds_and_nanoseconds(numbers: Sequence[str]) -> bool:
    """Whether what stands behind the point are whole nanoseconds, without zeros before them.

    Both readings can be meant if some have nine digits and others fewer. Pictures are taken at a steady rate, so the
    steadier one is right.
    """
    parts = [number.split(".") for number in numbers]
    lengths = {len(fraction) for _, fraction in parts}
    if len(lengths) < 2 or max(lengths) != _NANO or any(len(seconds) != _SINCE_1970 for seconds, _ in parts):
        return False
    counted = sorted(int(f"{seconds}{fraction:0>{_NANO}}") for seconds, fraction in parts)
    decimal = sorted(int(f"{seconds}{fraction:0<{_NANO}}") for seconds, fraction in parts)
    return _irregularity(counted) < _irregularity(decimal)


def _irregularity(times_ns: Sequence[int]) -> float:
    return irregularity(np.array([t_ns - times_ns[0] for t_ns in times_ns], np.int64))
