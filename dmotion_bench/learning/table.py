"""The training of all registered models with each of their label budgets: one run per row of the table.

Rows are independent. A row that is trained already is taken as it is, one that was interrupted goes on, one that fails
is noted with its sentence, and the next is trained.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.errors import DmbenchError, StorageFull
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.start import TrainingRequest, open_run
from dmotion_bench.registry import model_class, model_names
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

BUDGETS = {Supervision.NONE: ("one-shot", "5-shot", "20-shot"), Supervision.ACTIONS: ("100%", "10%")}
"""Label budgets of models that name none of their own."""

TRANSITIONS = ("64", "16", "256")
"""Label budgets of models of video where the actions are continuous."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A model under a label budget.

    Attributes:
        model: Registry name.
        labels: The budget; empty where the model could not be loaded and its budgets are not known.
    """

    model: str
    labels: str


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The result of training a row.

    Attributes:
        row: Which one.
        run: Its run, where there is one.
        error: Why it failed, in a sentence; None if it did not.
    """

    row: Row
    run: Run | None
    error: str | None = None


def budgets(kind: type[ForwardModel[Any]], actions: ActionSpec | None) -> tuple[str, ...]:
    """The label budgets that a class of models is ranked under on a data set with such actions."""
    video = kind.supervision is Supervision.NONE
    if actions is None:
        return ("none",) if video else ()
    named = kind.budgets or BUDGETS[kind.supervision]
    if isinstance(actions, Continuous):
        return tuple(name for name in named if not name.endswith("-shot")) or TRANSITIONS
    return named


def rows(dataset: Dataset) -> Iterator[Row]:
    """Every registered model under each of its budgets; where actions are not known, what needs none, without."""
    for name in model_names():
        named: tuple[str, ...] = ("",)  # of what cannot be loaded; said when the row is trained
        with contextlib.suppress(DmbenchError):
            kind = model_class(name)
            named = budgets(kind, dataset.spec.actions)
        for labels in named:
            yield Row(model=name, labels=labels)


def train_table(
    request: TrainingRequest, dataset: Dataset, workspace: Workspace, train: Callable[[Run], object]
) -> Iterator[Outcome]:
    """Train every row in turn.

    Args:
        request: What holds for all rows: preset, seed and split; model and labels are the row's.
        dataset: What all learn from.
        workspace: Where the runs are.
        train: Trains one run to its end.
    """
    for row in rows(dataset):
        run = None
        try:
            wanted = dataclasses.replace(request, model=row.model, labels=row.labels or None)
            run = open_run(wanted, dataset, None, workspace)
            train(run)
        except StorageFull:
            raise
        except Exception as error:  # a stranger's model may raise anything; the others are to be trained
            told = isinstance(error, DmbenchError)
            yield Outcome(row=row, run=run, error=str(error) if told else f"{type(error).__name__}: {error}")
        else:
            yield Outcome(row=row, run=run)
