"""A board's label curves as Markdown: each model's error by the number of its labels, and how many it needs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Sequence
from typing import Final

from leaderboard.board import Board
from leaderboard.efficiency import WITHIN, common_budgets, learned, needed_of_rows, of_budgets
from leaderboard.markdown import WIDTH, plain, table
from leaderboard.markdown_numbers import mean
from leaderboard.row import Row
from leaderboard.usual import RANKED_BY

MOST_BUDGETS: Final = 8
"""Besides that of all labels; a page has no room for more."""

SAID: Final = (
    f"Labels needed: the fewest labels from which on the MSE stays within {WITHIN:.0%} of the model's own with all "
    "labels. The table names the two measured budgets between which this number lies; a model with fewer than three "
    "of the table's budgets is not comparable. In brackets: the 95% interval over episodes and, where a budget has "
    "several trainings, over trainings, if it reaches beyond the two budgets. The cell is blank where the MSE with all "
    "labels is not below that of copying the last frame. The other columns have the MSE by the number of labels, which "
    "are the actions of that many transitions, whichever actions these show. A row has the same trainings under every "
    "budget; where no training has all budgets, a cell of fewer trainings says how many it has."
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
    copied = board.reference("copy_last").get(RANKED_BY)
    same = [of_budgets(rows, RANKED_BY, budgets) for rows in curves.values()]
    head = ["Model", "Labels needed", "Trainings", *(f"{count:,}" for count in shown), "all"]
    lines = [
        [
            plain(rows[-1].title),
            _needed(rows, budgets) if learned(rows, RANKED_BY, None if copied is None else copied.mean) else "",
            str(most := max(row.figures[RANKED_BY].seeds for row in rows)),
            *(_error(next((row for row in rows[:-1] if row.label_count == count), None), most) for count in shown),
            _error(rows[-1], most),
        ]
        for rows in same
    ]
    return [*textwrap.wrap(SAID, WIDTH), "", *table(head, lines)]


def _needed(rows: Sequence[Row], budgets: Collection[int]) -> str:
    found = needed_of_rows(rows, RANKED_BY, budgets)
    return "not comparable" if found is None else found.words


def _error(row: Row | None, most: int) -> str:
    """A row's error, and of how many trainings it is where others of its model have more."""
    if row is None:
        return ""
    value = row.figures[RANKED_BY]
    return mean(value) if value.seeds == most else f"{mean(value)} ({value.seeds} of {most})"
