"""The solver that tries every sequence: with four actions and five steps, 1,024 sequences and 1,364 frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Int

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext, best_first
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree

MOST: Final = 2_000_000
"""Sequences of one task: their costs take some 300 MB at five steps."""


@dataclass(frozen=True, kw_only=True)
class Exhaustive:
    """Computes the cost of every sequence.

    Attributes:
        horizon: Actions in a sequence; the work grows as actions ** horizon.
    """

    horizon: int = 5

    def __post_init__(self) -> None:
        if not 1 <= self.horizon <= 8:
            raise InvalidSetting(f"horizon is {self.horizon}; all sequences can be looked at for 1 to 8 steps.")

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """The cheapest sequence; among equally cheap ones, the first in the order of action numbers.

        Raises:
            InvalidSetting: There are more than ``MOST`` sequences, or the actions are continuous.
        """
        tree = PrefixTree(dynamics, evaluator, context.observation, self.horizon)
        if tree.actions**self.horizon > MOST:
            raise InvalidSetting(
                f"{self.horizon} steps of {tree.actions:,} actions make {tree.actions**self.horizon:,} sequences, and "
                f"all of at most {MOST:,} can be looked at; set a smaller horizon, or plan with 'icem'."
            )
        everything = all_sequences(tree.actions, self.horizon)
        sequences = np.broadcast_to(everything, (len(context.generators), *everything.shape))
        costs = tree.costs(sequences).min(axis=2)
        refused = context.blocked & ~context.blocked.all(axis=1, keepdims=True)
        costs = np.where(refused[:, everything[:, 0]], np.inf, costs)
        best, costs = best_first(sequences, costs)
        return tree.plan(best, costs, [costs[:, 0]])


def all_sequences(actions: int, horizon: int) -> Int[np.ndarray, "s t"]:
    """Every sequence of ``horizon`` actions, in lexicographic order."""
    grid = np.meshgrid(*[np.arange(actions)] * horizon, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, horizon)
