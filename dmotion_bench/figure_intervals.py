"""The 95% intervals and the spreads of a report's figures, as readers are shown them.

A report and an entry hold quantiles of the bootstrap's draws. Of most figures these are the interval. The variance of
latent actions within an action over that between actions is another case: episodes that are drawn twice move the means
of the actions apart, as chance did before. The draws of between / within are too high by as much as the figure's own
is, so its interval is the basic one: the quantiles reflected at the figure. It is read from the stored quantiles, so
it holds for earlier reports as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from dmotion_bench.wording import from_to, rounded

WITHIN_OVER_BETWEEN: Final = "motion_within_over_between"
WITHOUT_SPREAD: Final = frozenset({"codebook_perplexity", "codebook_used"})
"""Figures of all samples together: no sample has one of its own, so the std in their reports is no spread."""

Figure = Mapping[str, float | int | None]
"""As a report holds it: ``mean``, ``std``, ``low``, ``high`` and more."""


def interval_of(name: str, figure: Figure) -> tuple[float, float] | None:
    """The 95% interval of a figure; None where it has none.

    Of ``motion_within_over_between`` it always holds the figure, and its upper end is infinite where the latent actions
    may hold nothing of the action.

    Args:
        name: The figure's fixed name.
        figure: From a report or an entry.
    """
    mean, low, high = (figure[part] for part in ("mean", "low", "high"))
    if low is None or high is None:
        return None
    if name.partition("[")[0] != WITHIN_OVER_BETWEEN or not mean:
        return low, high
    least, most = (_inverse(2 / mean - _inverse(bound)) for bound in (high, low))
    return min(mean, least), max(mean, most)


def _inverse(value: float) -> float:
    return 1 / value if value > 0 else math.inf


def interval_words(name: str, figure: Figure) -> str:
    """The interval as text, such as ``0.12 to 0.34``; empty where there is none."""
    low, high = interval_of(name, figure) or (None, None)
    return from_to(low, high)


def mean_and_spread(name: str, figure: Figure) -> str:
    """A figure with the standard deviation over its samples, where these have values of their own: ``1.2 ± 0.3``."""
    mean = rounded(figure["mean"])
    is_alone = figure["std"] is None or name.partition("[")[0] in WITHOUT_SPREAD
    return mean if is_alone else f"{mean} ± {rounded(figure['std'])}"
