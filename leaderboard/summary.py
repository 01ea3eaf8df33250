"""The summary across worlds: how good each model is over all of them, and whether the next one is worse.

By the definitions of rliable (Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical
Precipice"), with worlds as its tasks and trainings as its runs:

- the interquartile mean (IQM) is the mean of the middle half of all scores of a model;
- its 95% interval is a stratified bootstrap: trainings are drawn anew within each world;
- the probability of improvement of one model over another is the mean over worlds of P(X > Y), by Mann and Whitney's U.

A score is ``1 - MSE / MSE of copying the last frame`` of the next frame on a world's test episodes: 0 is copying, 1 is
perfect, below 0 is worse than copying. ``tests/leaderboard/rliable_values.py`` holds the figures against rliable's.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy import stats

from dmotion_bench.errors import DmbenchError
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.scoring.label_use import USUAL_USES
from dmotion_bench.scoring.report import LABEL_USES
from dmotion_bench.specs import Preset
from leaderboard.board import Board
from leaderboard.row import USUAL_BUDGETS, Row
from leaderboard.usual import RANKED_BY

LEAST_MODELS: Final = 2
RESAMPLES: Final = 2_000
_USUAL: Final = frozenset(LABEL_USES.get(use, "") for use in USUAL_USES)
"""The variants of rows that have their model's usual settings: what a board says of them is how the model learns."""
Scores = Float[np.ndarray, "n w"]
"""Of trainings and worlds."""
_World = tuple[Board, dict[str, dict[str, Row]]]
"""A world's board, and its rows by model and label budget."""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A model in the summary.

    Attributes:
        model, labels: Registry name and label budget.
        rows: Its row on each world's board.
        scores: Of as many trainings in every world.
        iqm: Interquartile mean over worlds and trainings.
        interval: Of that over other trainings, 95%; None where there is one training in each world.
        over_next: The probability of improvement over the next model of the ranking; None for the last.
    """

    model: str
    labels: str
    rows: tuple[Row, ...]
    scores: Scores
    iqm: float
    interval: tuple[float, float] | None
    over_next: float | None

    @property
    def worlds(self) -> list[float]:
        """The mean score over the trainings in each world."""
        return [float(one) for one in self.scores.mean(axis=0)]

    @property
    def trainings(self) -> int:
        """In each world."""
        return len(self.scores)


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The models that have results in every world of the summary, the best first.

    Attributes:
        boards: One a world, that of most models: of those whose data set its usual recipe makes, or else of all.
        standings: The models.
        left_out: The names of models that lack a result with their usual settings in one of these worlds, by this
            version of scoring.
        too_small: The worlds with results of less than half as many models, which would leave most models out.
        unusual: The worlds in which no model was trained with its usual settings.
    """

    boards: tuple[Board, ...]
    standings: tuple[Standing, ...]
    left_out: tuple[str, ...]
    too_small: tuple[str, ...]
    unusual: tuple[str, ...]


def summarise(boards: Iterable[Board]) -> Summary | None:
    """The summary of some boards; None where there is nothing to compare across worlds."""
    best, places, measured = dict[str, _World](), dict[str, tuple[bool, int]](), set[str]()
    for board in boards:
        measured |= {row.model for row in _comparable_rows(board)}
        if board.made_by:  # scores of two versions are not averaged
            continue
        found = _usual_rows(board)
        place = bool(found) and _is_usual(board), len(found)
        if board.environment not in best or place > places[board.environment]:
            best[board.environment], places[board.environment] = (board, found), place
    most = max((len(found) for _, found in best.values()), default=0)
    chosen = [one for one in best.values() if len(one[1]) >= max(LEAST_MODELS, most / 2)]
    everywhere = {model for _, found in chosen for model in found if all(model in other for _, other in chosen)}
    ranked = sorted(
        (one for model in sorted(everywhere) if (one := _standing(model, chosen)) is not None),
        key=lambda one: -one.iqm,
    )
    if len(chosen) < 2 or len(ranked) < LEAST_MODELS:
        return None
    standings = [
        replace(one, over_next=None if after is None else probability_of_improvement(one.scores, after.scores))
        for one, after in zip(ranked, [*ranked[1:], None], strict=True)
    ]
    return Summary(
        boards=tuple(board for board, _ in chosen),
        standings=tuple(standings),
        left_out=tuple(sorted(measured - {one.model for one in ranked})),
        too_small=tuple(one[0].title for one in best.values() if one[1] and one not in chosen),
        unusual=tuple(board.title for board, found in best.values() if not found and _comparable_rows(board)),
    )


def _is_usual(board: Board) -> bool:
    """Whether a board's data set says that it is made by the usual recipe of its world, of any size."""
    for preset in Preset if board.recipe is not None else ():
        with contextlib.suppress(DmbenchError):  # the world has no such preset, or is not installed
            if recipe_for(board.environment, preset) == board.recipe:
                return True
    return False


def _usual_rows(board: Board) -> dict[str, dict[str, Row]]:
    """The rows of models with their usual settings, trained on the board's data set, by model and label budget."""
    found = dict[str, dict[str, Row]]()
    for row in _comparable_rows(board):
        if row.variant in _USUAL:
            found.setdefault(row.model, {})[row.labels] = row
    return {model: rows for model, rows in found.items() if any(budget in rows for budget in USUAL_BUDGETS)}


def _comparable_rows(board: Board) -> list[Row]:
    """The rows of models trained on the board's data set, by whatever settings; none where copying is not known."""
    if _baseline(board) is None or board.protocol == "paper":
        return []
    return [row for row in board.rows if row.kind == "measured" and not row.elsewhere and RANKED_BY in row.figures]


def _baseline(board: Board) -> float | None:
    """The error of copying the last frame."""
    copied = board.reference("copy_last").get(RANKED_BY)
    return copied.mean if copied is not None and copied.mean > 0 else None


def normalised(board: Board, row: Row) -> list[float]:
    """The score of each training of a row, in the order of their seeds."""
    baseline = _baseline(board)
    assert baseline is not None, "boards without copying are not taken"
    errors = [entry.figures[RANKED_BY]["mean"] for entry in row.entries if RANKED_BY in entry.figures]
    return [1 - float(error) / baseline for error in errors if error is not None]


def _standing(model: str, worlds: Sequence[_World]) -> Standing | None:
    """A model with its usual budget; None where no budget has results in every world."""
    budget = next((one for one in USUAL_BUDGETS if all(one in found[model] for _, found in worlds)), None)
    if budget is None:
        return None
    rows = tuple(found[model][budget] for _, found in worlds)
    known = [normalised(board, row) for (board, _), row in zip(worlds, rows, strict=True)]
    count = min(map(len, known))
    scores = np.array([own[:count] for own in known]).T
    return Standing(
        model=model,
        labels=budget,
        rows=rows,
        scores=scores,
        iqm=interquartile_mean(scores),
        interval=interval(interquartile_mean, scores) if count > 1 else None,
        over_next=None,
    )


def interquartile_mean(scores: Scores) -> float:
    """The mean of the middle half of all scores; of fewer than four of all of them."""
    return float(stats.trim_mean(scores, proportiontocut=0.25, axis=None))


def probability_of_improvement(first: Scores, second: Scores) -> float:
    """The mean over worlds of the probability that a training of the first model scores higher; ties count half."""
    return float(np.mean([_probability(*one) for one in zip(first.T, second.T, strict=True)]))


def _probability(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " m"]) -> float:
    return float(stats.mannwhitneyu(first, second, alternative="greater").statistic) / (len(first) * len(second))


def interval(
    figure: Callable[..., float], *scores: Scores, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[float, float]:
    """The 95% interval of a figure, by its quantiles over trainings that are drawn anew within each world.

    Args:
        figure: Of the scores of one model, or of several.
        scores: Of each model; they are drawn independently.
        resamples: How many draws.
        seed: Of the draws.
    """
    random = np.random.default_rng(seed)
    drawn = [
        figure(*(np.take_along_axis(one, random.integers(len(one), size=one.shape), axis=0) for one in scores))
        for _ in range(resamples)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)
