"""The page's tables: what they say of a row that is behind the best, tied with it, or neither."""

from __future__ import annotations

from typing import Any

import pytest

from dmotion_bench.scoring.statistics import Estimate
from leaderboard.board import Board
from leaderboard.entry import Entry
from leaderboard.row import Row
from leaderboard.standings import standings
from leaderboard.value import Value


def _row(name: str, mean: float, entry: Entry, **more: Any) -> Row:
    value = Value(mean=mean, low=None, high=None, std=None)
    return Row(kind="measured", name=name, model=name, entries=(entry,), figures={"mse": value}, **more)


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(2.0, 9.0, ">+5.00<"), (-1.0, 9.0, ">tie (+5.00)<"), (None, None, ">unknown, 4 episodes (+")],
)
def test_a_difference_over_too_few_episodes_is_not_shown_as_one(
    low: float | None, high: float | None, said: str, sound: Entry
) -> None:
    behind = Estimate(mean=5.0, std=1.0, low=low, high=high, n=40, episodes=4)
    rows = _row("best", 1.0, sound, is_best=True), _row("other", 6.0, sound, behind=behind)
    page = str(standings(Board(environment="grid_world", dataset="grid", rows=rows), "grid"))

    assert said in page
