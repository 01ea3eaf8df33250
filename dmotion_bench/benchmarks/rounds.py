"""Measuring in rounds: the work and what bounds it in turn, so that both see the same load on the machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from dmotion_bench.benchmarks.result import Result

ROUNDS: Final = 6
"""Of each speed. Two measurements whose rounds do not overlap are that far apart by chance once in 462 times."""

_SHARE: Final = 0.2  # of the work's time that goes into measuring the yardstick
Work = Callable[[], float]
"""Does a part of the work and says how much that was."""


@dataclass(frozen=True, kw_only=True)
class Yardstick:
    """Something simple that bounds a speed.

    Attributes:
        name: What it is.
        amount: How much would be done in the time of one call, in the unit of the speed that is bounded.
        work: Does it once.
    """

    name: str
    amount: float
    work: Callable[[], object]

    def rate(self, seconds: float, clock: Callable[[], float] = time.perf_counter) -> float:
        """The bound, measured for so long."""

        def step() -> float:
            self.work()
            return self.amount

        return _rate(step, seconds, clock)


def measure_in_rounds(
    name: str,
    unit: str,
    work: Work,
    seconds: float,
    yardstick: Yardstick | None = None,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> Result:
    """A speed and its bound, measured in turn.

    Args:
        name, unit: Of the speed.
        work: What is measured; called once before, to set up what later calls use again.
        seconds: How long ``work`` is measured, of all rounds together.
        yardstick: What bounds it.
        clock: Gives the time in seconds.
    """
    work()
    if yardstick is not None:
        yardstick.work()
    rounds, limits = list[float](), list[float]()
    for _ in range(ROUNDS):
        if yardstick is not None:
            limits.append(yardstick.rate(_SHARE * seconds / ROUNDS, clock))
        rounds.append(_rate(work, seconds / ROUNDS, clock))
    return Result(
        name=name,
        unit=unit,
        rounds=tuple(rounds),
        limits=tuple(limits),
        limit_name="" if yardstick is None else yardstick.name,
    )


def _rate(work: Work, seconds: float, clock: Callable[[], float]) -> float:
    began, done = clock(), work()
    while clock() - began < seconds:
        done += work()
    return done / (clock() - began)
