"""How well the gain captured agrees with other figures, over the rows of a board.

If it tells what predictions are worth for planning, rows with a higher gain leave less of the distance. Spearman's rank
correlation says how far that is so; its interval is a bootstrap over the rows. Each model and variant is one row, that
of its usual label budget: a model of video has one training under many budgets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from dmotion_bench.scoring.statistics import Estimate, rank_correlation
from leaderboard.column_table import ColumnTable, RowKey
from leaderboard.columns import POSITION_CHARGED, POSITION_FOUND, control_steps
from leaderboard.row import USUAL_BUDGETS
from leaderboard.value import Value

GAIN: Final = "planning_gain"
OTHERS: Final[Mapping[str, str]] = {
    "mse": "MSE",
    "mse_push": "MSE, pushes",
    "position_error_paper": f"{POSITION_CHARGED[0].lower()}{POSITION_CHARGED[1:]}",
    "position_error": f"{POSITION_FOUND[0].lower()}{POSITION_FOUND[1:]}",
}
FEWEST_ROWS: Final = 8
"""Of fewer a correlation looks certain and says little."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """The rank correlation of the gain captured with another figure.

    Attributes:
        figure: The other one, in words.
        correlation: Over rows that have both; negative where a higher gain goes with a lower error.
    """

    figure: str
    correlation: Estimate


def agreements(rows: Mapping[RowKey, Mapping[str, Value]], control: ColumnTable | None) -> tuple[Agreement, ...]:
    """The correlations that the rows of a board allow: with errors of prediction, and with control.

    Args:
        rows: The figures of the board's measured rows; of each model and variant one counts.
        control: The board's table of control by columns.
    """
    means = {key: {name: one.mean for name, one in rows[key].items()} for key in _one_of_each(rows)}
    last = max(control_steps(name for own in means.values() for name in own), default=0)
    others = dict(OTHERS) | ({f"control_distance[{last}]": f"distance left after {last} steps"} if last else {})
    if control is not None:
        for column in control.columns:
            for row in control.rows:
                if row.key in means and column in row.cells:
                    means[row.key][column] = row.cells[column].left.mean
            others[column] = f"distance left, column {column}"
    found = []
    for name, words in others.items():
        pairs = np.array([(own[GAIN], own[name]) for own in means.values() if GAIN in own and name in own])
        estimate = rank_correlation(*pairs.T) if len(pairs) >= FEWEST_ROWS else None
        if estimate is not None:
            found.append(Agreement(figure=words, correlation=estimate))
    return tuple(found)


def _one_of_each(rows: Mapping[RowKey, Mapping[str, Value]]) -> list[RowKey]:
    """Of each model and variant the row of its usual budget, or else its first one, among those with a gain."""
    chosen: dict[tuple[str, str], RowKey] = {}
    for key, figures in rows.items():
        model, variant, _ = key
        if GAIN in figures:
            chosen[model, variant] = min(chosen.get((model, variant), key), key, key=lambda one: _place(one[2]))
    return list(chosen.values())


def _place(labels: str) -> int:
    """Of a label budget among the usual ones; behind them if it is none of these."""
    return USUAL_BUDGETS.index(labels) if labels in USUAL_BUDGETS else len(USUAL_BUDGETS)
