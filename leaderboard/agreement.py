"""How well the gain captured agrees with other figures, over the rows of a board.

If it tells what predictions are worth for planning, rows with a higher gain leave less of the distance. Spearman's rank
correlation says how far that is so; its interval is a bootstrap over the rows. Each model and variant is one row, that
of its usual label budget: a model of video has one training under many budgets.

Control by frozen planners is scored on test tasks, so it stands in the table of another data set than the training's.
There it is the row of the same model, settings and label budget, whose trainings may have been others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dmotion_bench.planning.columns import HEADLINE
from dmotion_bench.scoring.statistics import Estimate, rank_correlation
from leaderboard.column_table import ColumnTable
from leaderboard.columns import POSITION_CHARGED, POSITION_FOUND, control_steps
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.row import USUAL_BUDGETS, Row
from leaderboard.run_names import training_of

GAIN: Final = "planning_gain"
OTHERS: Final[Mapping[str, str]] = {
    "mse": "MSE",
    "mse_push": "MSE, pushes",
    "position_error_paper": f"{POSITION_CHARGED[0].lower()}{POSITION_CHARGED[1:]}",
    "position_error": f"{POSITION_FOUND[0].lower()}{POSITION_FOUND[1:]}",
}
JOINED: Final = (
    "Control by a frozen planner is of the row of the same model, settings and labels in the table of that data set. "
    "That row may be of other trainings than the row here, so rows are compared, not trainings."
)


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """The rank correlation of the gain captured with another figure.

    Attributes:
        figure: The other one, in words.
        correlation: Over rows that have both; negative where a higher gain goes with a lower error.
        joined: Whether the other one is of rows of another table.
    """

    figure: str
    correlation: Estimate
    joined: bool = False


def agreements(rows: Sequence[Row], tables: Sequence[ColumnTable]) -> tuple[Agreement, ...]:
    """The correlations that the rows of a board allow: with errors of prediction, and with control.

    Args:
        rows: The board's measured rows; of each model and variant one counts.
        tables: The tables of control by columns, of all data sets.
    """
    chosen = _one_of_each(rows)
    means = [_comparable(row) for row in chosen]
    last = max(control_steps(name for own in means for name in own), default=0)
    others = dict(OTHERS) | ({f"control_distance[{last}]": f"distance left after {last} steps"} if last else {})
    found = [
        _agreement(words, [(own[GAIN], own[name]) for own in means if name in own]) for name, words in others.items()
    ]
    for table in tables:
        planned = ", ".join(part for part in (HEADLINE.title, table.made_by) if part)
        words = f"distance left after {table.steps} steps on {table.dataset} ({planned})"
        found.append(_agreement(words, _with_control(chosen, table), joined=True))
    return tuple(one for one in found if one is not None)


def _agreement(figure: str, pairs: Sequence[tuple[float, float]], *, joined: bool = False) -> Agreement | None:
    """The correlation of the gains with another figure; None of too few rows."""
    estimate = rank_correlation(*np.array(pairs, np.float64).reshape(-1, 2).T)
    return None if estimate is None else Agreement(figure=figure, correlation=estimate, joined=joined)


def _with_control(rows: Sequence[Row], table: ColumnTable) -> list[tuple[float, float]]:
    """The gains of a board's rows and what the headline's planner leaves with the same models.

    A row belongs to the training's own board, or to that of the tasks if the gain was measured there, too.
    """
    left = {}
    for row in table.compared:
        trainings = {training_of(entry) for entry in row.entries if entry.column == HEADLINE.name}
        if len(trainings) == 1 and HEADLINE.name in row.cells:
            left[trainings.pop()] = row.cells[HEADLINE.name].left.mean
    pairs = []
    for one in rows:
        first = one.entries[0]
        if not one.elsewhere or first.content["dataset"]["fingerprint"] == table.fingerprint:
            distance = left.pop(training_of(first), None)
            pairs += [(one.figures[GAIN].mean, distance)] if distance is not None else []
    return pairs


def _comparable(row: Row) -> dict[str, float]:
    """A row's figures, without those of control by another planner than the board's."""
    return {
        name: value.mean
        for name, value in row.figures.items()
        if not (row.planned_otherwise and name.startswith(CONTROLLED))
    }


def _one_of_each(rows: Sequence[Row]) -> list[Row]:
    """Of each model and variant the row of its usual budget, or else its first one, among those with a gain.

    Rows that are compared with none are left out.
    """
    chosen: dict[tuple[str, str], Row] = {}
    for row in rows:
        if GAIN in row.figures and not row.apart:
            name = row.model, row.variant
            chosen[name] = min(chosen.get(name, row), row, key=_place)
    return list(chosen.values())


def _place(row: Row) -> int:
    """Of a row's label budget among the usual ones; behind them if it is none of these."""
    return USUAL_BUDGETS.index(row.labels) if row.labels in USUAL_BUDGETS else len(USUAL_BUDGETS)
