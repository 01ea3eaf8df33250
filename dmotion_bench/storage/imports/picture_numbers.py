"""How far apart pictures are by the numbers in their names: ``frame_9.png`` and ``frame_14.png`` are five steps apart.

A jump of several pictures would otherwise look like one ordinary step. The number counts that varies from name to name.
It tells of missing pictures if the differences have one usual value, and the others are multiples of it. Times are
numbers, too: seconds since 1970 with decimals, or as many digits as milliseconds, microseconds or nanoseconds have.
Their usual difference need not be exact.

Other names, such as random ones and dates, tell nothing: their pictures follow one another as they are sorted.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Int64

from dmotion_bench.storage.imports.timeline import interval_ns, meant_hz, steady_hz

NUMBER: Final = re.compile(r"\d+(?:\.\d+)*")
"""A number in a name; a time with a fraction is one."""
_FEWEST: Final = 4  # names that can have a usual difference
_SECONDS: Final = re.compile(r"\d{10}\.\d+")  # since 1970
_TIME: Final = re.compile(r"\d{13}|\d{16}|\d{19}")  # in milliseconds, microseconds, nanoseconds
_UNITS_NS: Final = {13: 10**6, 16: 10**3, 19: 1}  # by the number of digits
_CLOCK: Final = re.compile(r"([01]\d|2[0-3])[0-5]\d[0-5]\d")
_DATE: Final = re.compile(rf"(19|20)\d\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])({_CLOCK.pattern}\d*)?")
_LONGEST: Final = 2**62  # [ns] that 64 bits hold
_MOST_CAMERAS: Final = 8  # that one folder holds pictures of
_MOST_LACKING: Final = 10  # of so many pictures of several cameras one may be missing
_SHORTEST_RUN: Final = 3  # pictures of an episode, on an average
_PARTS: Final = frozenset({60, *(10**digits for digits in range(1, 7))})  # so far the end of a longer number may count
_MOST_STEPS: Final = 1_000_000  # between two pictures: a longer pause is as good as endless


def steps_between(names: Sequence[str]) -> Int64[np.ndarray, " n"] | None:
    """How many steps each picture but the first comes after the one before; None if the names do not tell.

    Args:
        names: Of the pictures of one folder, in their order, with the same text around their numbers.
    """
    if len(names) < _FEWEST:
        return None
    columns = [list(column) for column in zip(*map(NUMBER.findall, names), strict=True)]
    times = [column for column in columns if _are_times(column)]
    numbers = [column for column in columns if not _are_dates(column, columns)]
    for told in (*map(_time_steps, times), *map(_number_steps, numbers)):
        if told is not None:
            return told
    return None


def hz_by_times(names: Sequence[str]) -> float | None:
    """How many pictures a second there are by the times in their names; None without steady times.

    Args:
        names: Of the pictures of one folder, in their order, with the same text around their numbers.
    """
    if len(names) < _FEWEST:
        return None
    for column in zip(*map(NUMBER.findall, names), strict=True):
        if _are_times(column) and _time_steps(column) is not None:
            return meant_hz(steady_hz(_since_ns(column)))
    return None


def repeated_with_others(names: Sequence[str]) -> tuple[list[str], int] | None:
    """The values of a number that has few, each with the same others, and how many others: as cameras are numbered.

    Args:
        names: Of the pictures of one folder, with the same text around their numbers.
    """
    rows = [tuple(NUMBER.findall(name)) for name in names]
    for place in range(len(rows[0]) if rows else 0):
        values = dict.fromkeys(row[place] for row in rows)
        if not 2 <= len(values) <= _MOST_CAMERAS:
            continue
        others = {row[:place] + row[place + 1 :] for row in rows}
        if len(others) > len(values) and _MOST_LACKING * len(rows) >= (_MOST_LACKING - 1) * len(values) * len(others):
            return list(values), len(others)
    return None


def begun_anew(names: Sequence[str]) -> tuple[str, int] | None:
    """Where a number in the names begins anew again and again, as the number of a picture does with each episode.

    None where it may be the end of a longer number that another one begins, such as ``12_99`` before ``13_00``.

    Args:
        names: Of the pictures of one folder, in their order, with the same text around their numbers.

    Returns:
        The number, and how often it begins.
    """
    texts = NUMBER.split(names[0]) if names else []
    for text, column in zip(texts, zip(*map(NUMBER.findall, names), strict=True), strict=False):
        if not all(number.isdecimal() for number in column):
            continue
        numbers = [int(number) for number in column]
        begins = [0, *(place for place, (one, two) in enumerate(pairwise(numbers), 1) if two <= one)]
        first, *others = {numbers[place] for place in begins}
        if others or len(begins) < 2 or len(numbers) < _SHORTEST_RUN * len(begins):
            continue
        lengths = {stop - start for start, stop in pairwise(begins)}
        if len(lengths) > 1 or lengths.isdisjoint(_PARTS) or any(map(str.isalpha, text)):
            return str(first), len(begins)
    return None


def _are_times(column: Sequence[str]) -> bool:
    are_of_one_unit = all(map(_TIME.fullmatch, column)) and len(set(map(len, column))) == 1
    return are_of_one_unit or all(map(_SECONDS.fullmatch, column))


def _are_dates(column: Sequence[str], columns: Sequence[Sequence[str]]) -> bool:
    """Whether numbers are dates, or times of day beside a date: 120100 comes a second after 120059."""
    if all(map(_DATE.fullmatch, column)):
        return True
    return all(map(_CLOCK.fullmatch, column)) and any(all(map(_DATE.fullmatch, other)) for other in columns)


def _time_steps(column: Sequence[str]) -> Int64[np.ndarray, " n"] | None:
    """The steps between times that are steady but for pauses."""
    since = _since_ns(column)
    if (np.diff(since) <= 0).any() or not steady_hz(since):
        return None
    return np.rint(np.diff(since) / interval_ns(since)).clip(1, _MOST_STEPS).astype(np.int64)


def _since_ns(column: Sequence[str]) -> Int64[np.ndarray, " n"]:
    """The times since the first one [ns]; zeros if they cannot be."""
    unit = 10**9 if "." in column[0] else _UNITS_NS[len(column[0])]
    times = [int(Decimal(number) * unit) for number in column]
    is_possible = 0 < times[-1] - times[0] < _LONGEST
    return np.array([(one - times[0]) * is_possible for one in times], np.int64)


def _number_steps(column: Sequence[str]) -> Int64[np.ndarray, " n"] | None:
    """The steps between whole numbers, most of which have one difference and the others multiples of it."""
    if not all(number.isdecimal() for number in column):
        return None
    differences = [later - earlier for earlier, later in pairwise(map(int, column))]
    usual = sorted(differences)[len(differences) // 2]
    if usual < 1 or 2 * differences.count(usual) <= len(differences):
        return None
    if any(one < usual or one % usual for one in differences):
        return None
    return np.array([min(one // usual, _MOST_STEPS) for one in differences], np.int64)
