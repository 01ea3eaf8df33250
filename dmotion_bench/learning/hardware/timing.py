"""Which of a few ways is faster here: all are tried in turn, and one replaces the usual one only if it clearly wins."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import torch

FEWEST_ROUNDS: Final = 3
MOST_ROUNDS: Final = 9
SECONDS: Final = 3.0
"""After so long the fewest rounds are enough."""
DECIDED: Final = 1.2
"""The fewest rounds are enough, too, where one way was faster than the others by this factor in each of them."""
MARGIN: Final = 1.05
OFTEN: Final = 0.75
"""The other way must be faster by the margin in the median and in so many of the rounds: noise is not to decide."""


def timed_in_turn(
    ways: Mapping[str, Callable[[], object]],
    device: torch.device,
    agreed: Callable[[Callable[[], bool]], bool] = lambda answer: answer(),
) -> dict[str, tuple[float, ...]]:
    """Seconds of each way, round by round, after one of each that does not count.

    Args:
        ways: What is tried.
        device: Where it computes.
        agreed: Answers a question alike for all processes that try the ways together: they take the same rounds.
    """
    for way in ways.values():
        _seconds(way, device)
    rounds: list[list[float]] = []
    began = time.perf_counter()
    while agreed(
        lambda: (
            len(rounds) < FEWEST_ROUNDS
            or (len(rounds) < MOST_ROUNDS and time.perf_counter() - began < SECONDS and not _is_decided(rounds))
        )
    ):
        rounds.append([_seconds(way, device) for way in ways.values()])
    return dict(zip(ways, zip(*rounds, strict=True), strict=True))


def _is_decided(rounds: Sequence[Sequence[float]]) -> bool:
    """Whether the same way was by far the fastest in every round."""
    first = min(range(len(rounds[0])), key=rounds[0].__getitem__)
    return all(one[first] * DECIDED < seconds for one in rounds for way, seconds in enumerate(one) if way != first)


def clearly_faster(other: Sequence[float], usual: Sequence[float]) -> bool:
    """Whether another way's seconds are clearly fewer than those of the usual one, round by round."""
    won = [one * MARGIN < two for one, two in zip(other, usual, strict=True)]
    return statistics.median(other) * MARGIN < statistics.median(usual) and sum(won) >= OFTEN * len(won)


def _seconds(way: Callable[[], object], device: torch.device) -> float:
    began = time.perf_counter()
    way()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began
