"""Figures of rows, and how the page and the documents write their intervals."""

from __future__ import annotations

import math

from leaderboard.columns import interval
from leaderboard.markdown_numbers import figure
from leaderboard.value import values_of

RATIO = "motion_within_over_between"
PUBLISHED = {"mean": 305.2, "std": 39.2, "low": 136.4, "high": 264.7, "n": 1604}


def test_an_earlier_entry_whose_ratio_lies_beside_its_quantiles_has_an_interval_around_it() -> None:
    found = values_of([{RATIO: PUBLISHED, "mse": PUBLISHED}])

    assert found[RATIO].interval == (305.2, math.inf)
    assert found[RATIO].interval == (found[RATIO].low, found[RATIO].high)
    assert found["mse"].interval == (136.4, 264.7)
    assert interval(*found[RATIO].interval) == "305 or more"
    assert figure(found[RATIO]) == "305 (305 or more)"


def test_several_trainings_without_sums_over_episodes_have_a_range_and_no_interval() -> None:
    found = values_of([{RATIO: PUBLISHED}, {RATIO: PUBLISHED | {"mean": 239.2}}])[RATIO]

    assert (found.low, found.high, found.interval) == (239.2, 305.2, None)
