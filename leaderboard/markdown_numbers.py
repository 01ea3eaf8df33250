"""Numbers in Markdown: means, intervals and spreads, with the same digits everywhere."""

from __future__ import annotations

from typing import Final

from dmotion_bench.wording import from_to, rounded
from leaderboard.value import Value

TO: Final = "\u00a0to\u00a0"
"""Between two numbers that stay on one line, by spaces that do not break."""


def figure(value: Value | None, *, strong: bool = False) -> str:
    """A mean with its 95% interval or, of published figures, their spread."""
    if value is None:
        return ""
    text = f"**{mean(value)}**" if strong else mean(value)
    if value.interval is not None:
        return f"{text} ({between(*value.interval)})"
    return text if value.std is None or value.samples is not None else f"{text} ± {rounded(value.std)}"


def mean(value: Value | None) -> str:
    """A mean alone."""
    return "" if value is None else rounded(value.mean)


def of_some(value: Value | None, trainings: int) -> str:
    """Behind a figure that is the mean of fewer trainings than there are: of how many, such as ``(1 of 3)``."""
    return "" if value is None or value.seeds >= trainings else f" ({value.seeds} of {trainings})"


def between(low: float | None, high: float | None) -> str:
    """An interval as text on one line, with two digits for numbers below 10."""
    return from_to(low, high, number=_short, to=TO)


def _short(value: float) -> str:
    return f"{value:#.2g}" if 1e-4 <= abs(value) < 9.95 else rounded(value)
