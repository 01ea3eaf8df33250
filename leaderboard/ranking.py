"""Who is the best of a board's rows, what each is behind by, and who leads in control.

Rows are compared by their paired difference. The best is one of the rows that are over the same frames, or tasks, as
most: a row over others, with which nobody could be paired, is compared with none.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from dmotion_bench.scoring.statistics import Estimate
from leaderboard.columns import control_steps
from leaderboard.comparison import difference_by_episode
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.entry import Entry
from leaderboard.row import Row
from leaderboard.usual import RANKED_BY, most_common


def ranked(rows: list[Row]) -> list[Row]:
    """The measured rows, each with its paired difference from the best, and whether it leads in control."""
    names = _all_figures(row for row in rows if not row.planned_otherwise)
    if steps := control_steps(names):
        rows = _leading(rows, f"control_distance[{steps[-1]}]")
    best = _best([row for row in rows if not row.unsound and not row.apart], RANKED_BY)
    if best is None:
        return rows
    return [
        replace(row, is_best=True) if row is best else replace(row, behind=_difference(row, best, RANKED_BY))
        for row in rows
    ]


def _best(rows: Iterable[Row], figure: str) -> Row | None:
    """The row with the lowest value of a figure, of those that are over the frames or tasks of most."""
    rows = [row for row in rows if figure in row.figures]
    votes = [(entry, entry.frames.get(figure)) for row in rows for entry in _behind_figure(row, figure)]
    usual = most_common([(entry, one) for entry, one in votes if one is not None])
    able = [row for row in rows if all(one.frames.get(figure) == usual for one in _behind_figure(row, figure))]
    return min(rows if usual is None else able, key=lambda row: row.figures[figure].mean, default=None)


def _behind_figure(row: Row, figure: str) -> list[Entry]:
    """The entries whose mean a row's figure is."""
    controlled = figure.startswith(CONTROLLED)
    return [
        entry for entry in row.entries if figure in entry.figures and (not controlled or entry.planner == row.planner)
    ]


def _all_figures(rows: Iterable[Row]) -> set[str]:
    return {name for row in rows for name in row.figures}


def _leading(rows: list[Row], figure: str) -> list[Row]:
    """The rows, with a mark on those that have the lowest value of a figure or are tied with it."""
    best = _best([row for row in rows if not row.planned_otherwise and not row.unsound], figure)
    if best is None:
        return rows
    marked = []
    for row in rows:
        apart = None if row is best or row.unsound else _difference(row, best, figure)
        leads = row is best or (apart is not None and apart.low is not None and apart.low <= 0 <= (apart.high or 0))
        marked.append(replace(row, leads=row.leads | {figure}) if leads else row)
    return marked


def _difference(row: Row, best: Row, figure: str) -> Estimate | None:
    """The paired difference of a row from the best; None of what is compared with none, or of different planners."""
    apart = row.planner != best.planner if figure.startswith(CONTROLLED) else row.apart
    if figure not in row.figures or apart:
        return None
    sums = [
        [
            entry.by_episode[figure]
            for entry in _behind_figure(one, figure)
            if figure in entry.by_episode and entry.frames.get(figure) is not None
        ]
        for one in (row, best)
    ]
    if any(len(own) != one.figures[figure].seeds for own, one in zip(sums, (row, best), strict=True)):
        return None
    return difference_by_episode(*sums)
