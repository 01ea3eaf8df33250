"""A row of a board: a model under one label budget, what was published of it, or a reference."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from dmotion_bench.scoring.statistics import Estimate
from leaderboard.entry import Entry, Planner
from leaderboard.value import Value

RowKind = Literal["measured", "published", "reference"]

USUAL_BUDGETS: Final = ("one-shot", "100%", "all")
"""The usual label budgets, the first that a model has: that of the paper's method, else all labels."""

DEMONSTRATIONS: Final = re.compile(r"(one|\d+)-shot(-per-agent)?")
EACH_MEANING: Final = (
    "Labels such as 4 (1 each) are demonstrations, one of each of four actions. Without such a bracket they are the "
    "actions of that many transitions, whichever actions these show, so a small number may lack an action."
)


def each(labels: str) -> str:
    """How many demonstrations of each action a budget asks for, such as ``1 each``; empty for another budget."""
    found = DEMONSTRATIONS.fullmatch(labels)
    return f"{found[1].replace('one', '1')} each" if found else ""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A model on a board.

    Attributes:
        kind: Measured here, printed elsewhere, or a predictor that knows nothing.
        name: What it is called: the model's registry name, or what the reference does.
        model: Gives it its colour, together with its variant; empty for references.
        variant: What tells it from others of the model and budget, often nothing.
        labels, label_count: The budget and what it came to.
        entries: The results behind it.
        figures: By their fixed names.
        behind: How much higher its error is than the best's, paired; None where that is not known.
        is_best: Whether it is the one the others are compared with.
        elsewhere: Whether it was trained on another data set than the board's.
        leads: Other figures in which it is the best, or statistically tied with the best.
        planner: The planner behind its figures of control; None where it has none.
        planned_otherwise: Whether that is another one than the board's.
        unsound: Whether its model breaks the contract: it is neither the best nor tied with the best.
        apart: Whether its predictions are of other frames, or in another precision, than the others of the board, or a
            training that counts in another row: they are compared with none.
    """

    kind: RowKind
    name: str
    model: str = ""
    variant: str = ""
    labels: str = ""
    label_count: int | None = None
    entries: tuple[Entry, ...] = ()
    figures: Mapping[str, Value]
    behind: Estimate | None = None
    is_best: bool = False
    elsewhere: bool = False
    leads: frozenset[str] = frozenset()
    planner: Planner | None = None
    planned_otherwise: bool = False
    unsound: bool = False
    apart: bool = False

    @property
    def title(self) -> str:
        """The row's name, its variant, and whether it was published elsewhere."""
        words = [self.name, self.variant and f"({self.variant})", self.kind == "published" and "as published"]
        return " ".join(word for word in words if word)

    @property
    def seeds(self) -> int:
        """Runs that it is the mean of."""
        return len(self.entries)

    @property
    def ties(self) -> bool:
        """Whether the row is the best, or tied with the best."""
        if self.is_best or self.unsound or self.behind is None or self.behind.low is None:
            return self.is_best
        return self.behind.low <= 0 <= (self.behind.high or 0)
