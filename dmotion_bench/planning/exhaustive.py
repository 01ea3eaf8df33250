"""The planner that tries every sequence: with four actions and five steps, 1,024 sequences and 1,364 frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.futures import Futures
from dmotion_bench.planning.planner import SHOWN, Moment, Plan, best_first
from dmotion_bench.planning.tree import FutureTree


@dataclass(frozen=True, kw_only=True)
class ExhaustivePlanner:
    """Computes the cost of every sequence.

    Attributes:
        horizon: Actions in a sequence; the work grows as actions ** horizon.
    """

    horizon: int = 5

    def __post_init__(self) -> None:
        if not 1 <= self.horizon <= 8:
            raise InvalidSetting(f"horizon is {self.horizon}; all sequences can be looked at for 1 to 8 steps.")

    def plan(self, futures: Futures, moment: Moment) -> Plan:
        """The cheapest sequence; among equally cheap ones, the first in the order of action numbers."""
        tree = FutureTree(futures, self.horizon)
        everything = all_sequences(futures.actions, self.horizon)
        sequences = np.broadcast_to(everything, (futures.tasks, *everything.shape))
        costs = tree.costs(sequences).min(axis=2)
        refused = moment.blocked & ~moment.blocked.all(axis=1, keepdims=True)
        costs = np.where(refused[:, everything[:, 0]], np.inf, costs)
        best, price = best_first(sequences, costs, SHOWN)
        return Plan(action=best[:, 0, 0], candidates=best, costs=price, progress=price[:, :1], frames=tree.frames)


def all_sequences(actions: int, horizon: int) -> Int[np.ndarray, "s t"]:
    """Every sequence of ``horizon`` actions, in lexicographic order."""
    grid = np.meshgrid(*[np.arange(actions)] * horizon, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, horizon)
