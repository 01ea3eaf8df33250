"""A board's label curves as Markdown: each model's error by the number of its labels, and how many it needs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Final

from leaderboard.board import RANKED_BY, Board
from leaderboard.efficiency import WITHIN, LabelsNeeded, common_budgets, needed_of_rows
from leaderboard.markdown import WIDTH, plain, table
from leaderboard.markdown_numbers import between, mean, written
from leaderboard.row import Row

MOST_BUDGETS: Final = 8
"""Besides that of all labels; a page has no room for more."""

SAID: Final = (
    f"Labels needed: the fewest from which on the MSE stays within {WITHIN:.0%} of the model's own with all labels, "
    "judged by the budgets of this table (not comparable with fewer than three of them), with the 95% interval over "
    "episodes and, where a budget has several, trainings. Then the MSE by the number of labels."
)


def label_lines(board: Board) -> list[str]:
    """The table of a board's label curves under the budgets that most of its models have; nothing without curves.

    Of many budgets every second, third ... is shown, down from the largest.
    """
    curves = board.label_curves
    if not curves:
        return []
    budgets = common_budgets(curves.values())
    shown = budgets[:: -math.ceil(len(budgets) / MOST_BUDGETS)][::-1] if budgets else []
    by_count = [{row.label_count or 0: row for row in rows[:-1]} for rows in curves.values()]
    head = ["Model", "Labels needed", "Trainings", *(f"{count:,}" for count in shown), "all"]
    lines = [
        [
            plain(rows[-1].title),
            _needed(needed_of_rows(rows, RANKED_BY, budgets)),
            _trainings(rows),
            *(mean(points[count].figures[RANKED_BY]) if count in points else "" for count in shown),
            mean(rows[-1].figures[RANKED_BY]),
        ]
        for rows, points in zip(curves.values(), by_count, strict=True)
    ]
    return [*textwrap.wrap(SAID, WIDTH), "", *table(head, lines)]


def _needed(found: LabelsNeeded | None) -> str:
    if found is None:
        return "not comparable"
    text = f"{'at most ' if found.at_most else ''}{written(found.labels)}"
    return text if found.low is None or found.high is None else f"{text} ({between(found.low, found.high)})"


def _trainings(rows: Sequence[Row]) -> str:
    counts = sorted({row.figures[RANKED_BY].seeds for row in rows})
    return str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
