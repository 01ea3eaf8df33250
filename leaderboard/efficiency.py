"""What labels are worth to a model: its label curve, and how many it needs to come close to its own best.

A label curve is a model's error under each of its label budgets, on the same frames. Its figure is *the labels needed*:
the fewest labels from which on the error stays within 10% of the model's own error with all labels. Between two
measured budgets the curve is a straight line over the logarithm of the number of labels, so the figure depends on which
budgets were measured: of a board it counts those that most of its models have. Where even the smallest of them is close
enough, the figure is that budget, and says *at most*. What is shown are the two measured budgets between which the
figure lies: nothing was measured between them.

A model whose error with all labels is not below that of copying the last frame has no such figure: it comes close to
its own best at once, because it learned nothing. Its budgets are compared by the same trainings, as far as there are
some that have all of them.

The interval is from a bootstrap: in each draw episodes are drawn anew, the same ones for all budgets, and so are
trainings where there are several; the figure is found anew on each drawn curve. What drawn trainings differ from the
mean of all, as a factor, is widened for their small number (``trainings.widening``).
"""

from __future__ import annotations

import bisect
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dmotion_bench.scoring.statistics import FEWEST_EPISODES, SEED, expanded_tail
from dmotion_bench.scoring.trainings import as_factor, widening
from leaderboard.row import Row
from leaderboard.value import values_of

WITHIN: Final = 0.1
ALL: Final = "100%"
FEWEST_BUDGETS: Final = 3
SHOT: Final = "-shot"
"""In the name of a budget that counts demonstrations of each action."""
RESAMPLES: Final = 2000
ROUNDING: Final = 1e-9
"""Share of a number of labels by which its logarithm and back may raise it."""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """A model's errors under one label budget.

    Attributes:
        labels: That were handed out.
        is_all: Whether these are all labels.
        sums: Of each training the sums over episodes, as ``comparison.sums_by_episode`` gives them of a figure.
        seeds: Of each training.
    """

    labels: int
    is_all: bool
    sums: Sequence[Mapping[str, Any]]
    seeds: Sequence[int]


@dataclass(frozen=True, kw_only=True)
class LabelsNeeded:
    """How many labels a model needs to come within a share of its own error with all labels.

    Attributes:
        labels: So many.
        low, high: The 95% interval over episodes and trainings; None where fewer than ``FEWEST_EPISODES`` were scored.
        budgets: The numbers of labels that were measured, rising; the last is all.
    """

    labels: float
    low: float | None
    high: float | None
    budgets: tuple[int, ...]

    @property
    def at_most(self) -> bool:
        """Whether the smallest budget that was measured is close enough, so that it may be fewer."""
        return self.labels <= self.budgets[0]

    @property
    def words(self) -> str:
        """Between which measured budgets the figure lies, and its interval where that reaches beyond them."""
        below, above = self._beside(self.labels)
        text = f"at most {below:,}" if self.at_most else f"between {below:,} and {self._named(above)}"
        if self.low is None or self.high is None:
            return text
        lowest, highest = self._beside(self.low)[0], self._beside(self.high)[1]
        fewer = self.low <= self.budgets[0]
        if (lowest, highest, fewer) == (below, above, self.at_most):
            return text
        return f"{text} ({'at most ' if fewer else ''}{lowest:,} to {self._named(highest)})"

    def _beside(self, labels: float) -> tuple[int, int]:
        """The measured budgets below and above a number of labels; the smallest twice where that is enough."""
        place = min(bisect.bisect_left(self.budgets, labels * (1 - ROUNDING)), len(self.budgets) - 1)
        return self.budgets[max(place - 1, 0)], self.budgets[place]

    def _named(self, budget: int) -> str:
        return "all" if budget == self.budgets[-1] else f"{budget:,}"


def crossing(labels: Sequence[float], errors: Sequence[float], bound: float) -> float:
    """The fewest labels from which on a curve stays at or below a bound; all of them if only the last point is.

    Args:
        labels: Of each point, rising.
        errors: Of each point; the last one is not above the bound.
        bound: Which error counts as close enough.
    """
    place = len(errors) - 1
    while place and errors[place - 1] <= bound:
        place -= 1
    if place == 0:
        return float(labels[0])
    above, below = errors[place - 1], errors[place]
    share = (above - bound) / (above - below)
    left, right = math.log2(labels[place - 1]), math.log2(labels[place])
    return float(2 ** (left + share * (right - left)))


def labels_needed(points: Sequence[CurvePoint], within: float = WITHIN) -> LabelsNeeded | None:
    """The figure of a label curve; None if it has no point with all labels, or its points are not of the same frames.

    Args:
        points: At least two, in any order.
        within: Share of the error with all labels by which another may be higher.
    """
    points = sorted(points, key=lambda point: point.labels)
    if len(points) < 2 or not points[-1].is_all or any(not point.sums for point in points):
        return None
    first = points[0].sums[0]
    for point in points:
        if any((one["episode"], one["n"]) != (first["episode"], first["n"]) for one in point.sums):
            return None
    counts = np.asarray(first["n"], np.float64)
    totals = [np.array([one["sum"] for one in point.sums], np.float64) for point in points]
    labels = [point.labels for point in points]

    def found(errors: Sequence[float]) -> float:
        return crossing(labels, errors, (1 + within) * errors[-1])

    errors = [float(one.mean(0).sum() / counts.sum()) for one in totals]
    low = high = None
    if len(counts) >= FEWEST_EPISODES:
        generator = np.random.default_rng(SEED)
        together = len({tuple(point.seeds) for point in points}) == 1
        drawn = [found(errors) for errors in _drawn(totals, counts, together, generator)]
        tail = expanded_tail(len(counts))
        low, high = (float(one) for one in np.quantile(drawn, [tail, 1 - tail]))
    needed = found(errors)
    return LabelsNeeded(labels=needed, low=low, high=high, budgets=tuple(labels))


def _drawn(
    totals: Sequence[Float[np.ndarray, "s e"]],
    counts: Float[np.ndarray, " e"],
    together: bool,
    generator: np.random.Generator,
) -> list[tuple[float, ...]]:
    """The errors of curves whose episodes and trainings are drawn anew; trainings together if they are the same."""
    episodes = np.empty((RESAMPLES, len(counts)), np.int64)
    trainings = [np.empty((RESAMPLES, len(total)), np.int64) for total in totals]
    for draw in range(RESAMPLES):
        episodes[draw] = generator.integers(len(counts), size=len(counts))
        shared = generator.integers(len(totals[0]), size=len(totals[0]))
        for own in trainings:
            own[draw] = shared if together else generator.integers(own.shape[1], size=own.shape[1])
    frames = counts[episodes].sum(1)
    errors = []
    for total, own in zip(totals, trainings, strict=True):
        of_each = total[:, episodes].sum(-1) / frames
        drawn, middle = np.take_along_axis(of_each.T, own, axis=1).mean(1), of_each.mean(0)
        errors.append(as_factor(drawn, middle, widening(total, counts)))
    return list(zip(*(one.tolist() for one in errors), strict=True))


def label_curves(rows: Iterable[Row], figure: str) -> dict[tuple[str, str], list[Row]]:
    """The rows of each model and variant that were measured under several budgets, the last of them all labels."""
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        if row.kind == "measured" and row.label_count and figure in row.figures:
            groups[row.model, row.variant].append(row)
    curves = {name: lines_of(own)[0] for name, own in groups.items()}
    return {name: own for name, own in curves.items() if len(own) >= FEWEST_BUDGETS and own[-1].labels == ALL}


def beside_curves(rows: Sequence[Row], figure: str) -> list[Row]:
    """The rows without the points of label curves that have only a number for a budget."""
    points = {id(row) for own in label_curves(rows, figure).values() for row in own if row.labels.isdecimal()}
    return [row for row in rows if id(row) not in points]


def lines_of(rows: Sequence[Row]) -> list[list[Row]]:
    """The rows of a model by the number of their labels: as one line, or as two.

    Demonstrations of each action are another kind of budget than a number of labels, which may lack an action. Where
    numbers alone make a curve, demonstrations are the second line.
    """
    rows = sorted(rows, key=lambda row: row.label_count or 0)
    shots = [row for row in rows if SHOT in row.labels]
    numbered = [row for row in rows if SHOT not in row.labels]
    return [numbered, shots] if shots and len(numbered) >= FEWEST_BUDGETS else [rows]


def common_budgets(curves: Collection[Sequence[Row]]) -> list[int]:
    """The numbers of labels, besides all of them, that more than half of some label curves have."""
    having = Counter(count for rows in curves for count in {row.label_count or 0 for row in rows[:-1]})
    return sorted(count for count, models in having.items() if 2 * models > len(curves))


def of_budgets(rows: Sequence[Row], figure: str, budgets: Collection[int]) -> list[Row]:
    """The rows of a label curve that have some numbers of labels, and that of all labels, of the same trainings.

    Trainings are known by their seeds. Where none has all these budgets, or a row's figure leaves out a training that
    was measured with other settings, each row keeps those that it has.

    Args:
        rows: One for each budget of a model, the last of them all labels.
        figure: Which its rows are compared by; the others stay those of all trainings.
        budgets: Numbers of labels that count, besides all.
    """
    rows = [row for row in rows[:-1] if row.label_count in budgets] + [*rows[-1:]]
    having = [[entry.content["seed"] for entry in row.entries if figure in entry.figures] for row in rows]
    if any(len(own) != row.figures[figure].seeds for own, row in zip(having, rows, strict=True)):
        return rows
    seeds = [set(own) for own in having]
    common = set[int]().union(*seeds[:1]).intersection(*seeds)
    return [_of_seeds(row, figure, common) for row in rows] if common else rows


def _of_seeds(row: Row, figure: str, seeds: Collection[int]) -> Row:
    entries = tuple(entry for entry in row.entries if entry.content["seed"] in seeds and figure in entry.figures)
    own = values_of(
        [{figure: entry.figures[figure]} for entry in entries],
        [{figure: entry.by_episode[figure]} for entry in entries if figure in entry.by_episode],
    )
    return replace(row, entries=entries, figures={**row.figures, **own})


def learned(rows: Sequence[Row], figure: str, copying: float | None) -> bool:
    """Whether a model's error with all labels, the last row, is below that of copying, where that is known."""
    return copying is None or rows[-1].figures[figure].mean < copying


def needed_of_rows(rows: Sequence[Row], figure: str, budgets: Collection[int]) -> LabelsNeeded | None:
    """The labels needed by the model of some rows; None where too few of the budgets were measured.

    Args:
        rows: One for each of its budgets, the last of them all labels.
        figure: By which it is judged.
        budgets: Numbers of labels that count, besides all.
    """
    rows = of_budgets(rows, figure, budgets)
    if len(rows) < FEWEST_BUDGETS:
        return None
    points = [
        CurvePoint(
            labels=row.label_count or 0,
            is_all=row.labels == ALL,
            sums=[entry.by_episode[figure] for entry in row.entries if figure in entry.by_episode],
            seeds=[int(entry.content["seed"]) for entry in row.entries if figure in entry.by_episode],
        )
        for row in rows
    ]
    return labels_needed(points)
