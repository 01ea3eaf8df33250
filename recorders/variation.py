"""Factors of variation: what may differ from episode to episode, and how an episode's values are drawn.

By default nothing varies, as in the paper. A factor named in ``vary`` is drawn anew for each episode; a factor
given a value keeps it. Each factor has a random stream of its own, made of the episode's entropy and the factor's
name, so that varying one changes nothing else: not the other factors, not where the objects stand.

A factor is drawn from its usual range, or, for a test of what lies outside of a model's training, from ranges that
have no value in common with it. The same seeds give the same scenes and tables in both.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import Scalar


class Ranges(StrEnum):
    """What varying factors are drawn from."""

    IN_DISTRIBUTION = "in-distribution"  # each factor's ``low`` to ``high``
    SHIFTED = "shifted"  # each factor's ``shifted``, outside of that


@dataclass(frozen=True, kw_only=True)
class Factor:
    """Something that may vary between episodes.

    Attributes:
        name: What recipes and ``reset``'s options call it.
        usual: Its value where it does not vary.
        low, high: What it is drawn from, uniformly; both included where it is whole.
        shifted: Intervals outside of that, from which a shifted data set draws, uniformly over all of them.
        whole: Whether it is a count.
        each: Whether every object has a value of its own; then named ``factor/object`` among an episode's values.
        meaning: For people, with its unit.
    """

    name: str
    usual: float
    low: float
    high: float
    whole: bool = False
    each: bool = False
    shifted: tuple[tuple[float, float], ...]
    meaning: str

    def __post_init__(self) -> None:
        for low, high in self.shifted:
            if low > high or (low <= self.high and high >= self.low):
                raise ValueError(f"{self.name}: {low:g} to {high:g} is not outside of {self.low:g} to {self.high:g}")

    @property
    def least(self) -> float:
        """The smallest value that it can have."""
        return min([self.low, *(low for low, _ in self.shifted)])

    @property
    def most(self) -> float:
        """The largest value that it can have."""
        return max([self.high, *(high for _, high in self.shifted)])

    @property
    def explained(self) -> str:
        """What it is and what it is drawn from, in a line."""
        outside = " or ".join(f"{low:g} to {high:g}" for low, high in self.shifted)
        return f"{self.meaning}: {self.low:g} to {self.high:g}; shifted: {outside}"

    def draw(self, generator: np.random.Generator, ranges: Ranges = Ranges.IN_DISTRIBUTION) -> float:
        """One value."""
        intervals = self.shifted if ranges is Ranges.SHIFTED else ((self.low, self.high),)
        if self.whole:
            values = [value for low, high in intervals for value in range(int(low), int(high) + 1)]
            return values[int(generator.integers(len(values)))]
        place = float(generator.uniform(0, sum(high - low for low, high in intervals)))
        for low, high in intervals[:-1]:
            if place <= high - low:
                return round(low + place, 6)
            place -= high - low
        return round(intervals[-1][0] + place, 6)


class Variation:
    """The factors that an environment knows.

    Args:
        factors: All of them.
        objects: The names of the objects that ``each`` speaks of.
        ranges: What the factors that vary are drawn from.

    Raises:
        UnknownName: There are no such ranges.
    """

    def __init__(self, factors: Iterable[Factor], objects: Iterable[str], ranges: str = Ranges.IN_DISTRIBUTION) -> None:
        if ranges not in set(Ranges):
            raise UnknownName("ranges", ranges, [known.value for known in Ranges])
        self._factors = {factor.name: factor for factor in factors}
        self._objects = tuple(objects)
        self._ranges = Ranges(ranges)

    def check(self, vary: Iterable[str], fixed: Mapping[str, Any]) -> None:
        """Refuse names and values that cannot be.

        Raises:
            UnknownName: No such factor, or no such object.
            InvalidSetting: A value that is no number, or none that the factor can take.
        """
        for name in vary:
            if name not in self._factors:
                raise UnknownName("factor of variation", name, self._factors)
        for key, value in fixed.items():
            factor = self._factor_of(key)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
                raise InvalidSetting(f"{key}={value!r} is no number; it means: {factor.meaning}.")
            if not factor.least <= value <= factor.most or (factor.whole and value != int(value)):
                kind = "a whole number" if factor.whole else "a number"
                raise InvalidSetting(
                    f"{key}={value!r} is not possible; it takes {kind} from {factor.least:g} to {factor.most:g}: "
                    f"{factor.meaning}."
                )

    def values(self, entropy: int, vary: Iterable[str], fixed: Mapping[str, Any]) -> dict[str, Scalar]:
        """An episode's values of the factors that vary or are fixed; what is fixed is not drawn."""
        self.check(vary, fixed)
        values: dict[str, Scalar] = {}
        for factor in self._factors.values():
            generator = np.random.default_rng([entropy, zlib.crc32(factor.name.encode())])
            for key in self._keys(factor):
                drawn = factor.draw(generator, self._ranges)
                given = fixed.get(key, fixed.get(factor.name))
                if given is not None:
                    values[key] = int(given) if factor.whole else float(given)
                elif factor.name in vary:
                    values[key] = drawn
        return values

    def of(self, values: Mapping[str, Scalar], name: str, of_object: str | None = None) -> float:
        """The value of a factor in an episode, the usual one where it was neither varied nor fixed."""
        key = name if of_object is None else f"{name}/{of_object}"
        return float(values.get(key, self._factors[name].usual))

    def _keys(self, factor: Factor) -> list[str]:
        return [f"{factor.name}/{one}" for one in self._objects] if factor.each else [factor.name]

    def _factor_of(self, key: str) -> Factor:
        known = self._factors | {key: factor for factor in self._factors.values() for key in self._keys(factor)}
        if key not in known:
            raise UnknownName("factor of variation", key, known)
        return known[key]


def explained(factors: Iterable[Factor]) -> Mapping[str, str]:
    """Factors by their names, each explained; as an environment's class tells of them."""
    return MappingProxyType({factor.name: factor.explained for factor in factors})


def named_factors(vary: str | Iterable[str]) -> tuple[str, ...]:
    """Factors named as a list, or in one word such as ``"light,camera"``, as recipes store parameters."""
    names = vary.split(",") if isinstance(vary, str) else vary
    return tuple(name.strip() for name in names if name.strip())
