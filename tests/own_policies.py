"""Recording policies as a user writes them."""

from __future__ import annotations

from typing import Any


def right(env: Any, generator: Any) -> int:
    """Always to the right."""
    return 1


class Alternating:
    """Left and right in turn, from the left in every episode."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, env: Any, generator: Any) -> int:
        self.count += 1
        return (self.count + 1) % 2


def clumsy(env: Any, generator: Any) -> int:
    """Fails."""
    raise KeyError("speed")


def impossible(env: Any, generator: Any) -> int:
    """Chooses what there is not."""
    return 7


class Needy:
    """Wants to be told something when it is made."""

    def __init__(self, speed: float) -> None:
        self.speed = speed


class Failing:
    """Cannot be made."""

    def __init__(self) -> None:
        raise ValueError("no weights")
