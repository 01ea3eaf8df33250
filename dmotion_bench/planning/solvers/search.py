"""What all solvers share: sequences are predicted once, the cheapest are kept, and a plan is made of these."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.errors import PlannerContractBroken
from dmotion_bench.planning.objectives.base import PARTS
from dmotion_bench.planning.solvers.base import Plan, Sequences


def known_costs(costs: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The costs, if all are numbers; infinite ones are.

    Raises:
        PlannerContractBroken: One is NaN.
    """
    if np.isnan(costs).any():
        raise PlannerContractBroken("the objective gives costs that are not numbers (NaN), so nothing can be planned.")
    return costs


def require_sequences(sequences: Any, spec: ActionSpec, tasks: int) -> None:
    """Refuse what is no array of sequences of actions.

    Args:
        sequences: ``(tasks, sequences, steps)`` whole numbers, or of continuous actions ``(tasks, sequences, steps,
            numbers)``.
        spec: What can be done.
        tasks: How many there are.

    Raises:
        PlannerContractBroken: They have another shape or type, or there is none.
    """
    discrete = isinstance(spec, Discrete)
    kind, known = (np.integer if discrete else np.floating), isinstance(sequences, np.ndarray)
    fits = known and sequences.ndim == 3 + len(spec.shape) and sequences.shape[3:] == spec.shape
    if not (fits and len(sequences) == tasks and sequences.size and np.issubdtype(sequences.dtype, kind)):
        found = f"{sequences.dtype} of the shape {sequences.shape}" if known else f"a {type(sequences).__name__}"
        wanted = ", ".join(map(str, (tasks, "sequences", "steps", *spec.shape)))
        raise PlannerContractBroken(
            f"the solver tries {found} as its sequences; they must be a NumPy array of the shape ({wanted}), of "
            f"{'whole' if discrete else 'floating-point'} numbers, with one sequence and one step at least."
        )


class Search(ABC):
    """Predicts sequences of actions for some tasks from one control step on, and remembers what they cost.

    Attributes:
        frames: How many states have been predicted.
    """

    frames: int

    @abstractmethod
    def stacked_costs(self, sequences: Any) -> Float[np.ndarray, "b s t 4"]:
        """The cost of each sequence of each task after each of its steps, and the parts of the cost."""

    def costs(self, sequences: Sequences) -> Float[np.ndarray, "b s t"]:
        """The cost of each sequence of each task after each of its steps.

        Raises:
            PlannerContractBroken: They are no sequences of actions that exist, or the objective gives costs that are
                not numbers.
        """
        return known_costs(self.stacked_costs(sequences)[..., 0])

    def parts(self, sequences: Sequences, step: Int[np.ndarray, "b s"]) -> Mapping[str, Float[np.ndarray, "b s"]]:
        """The parts of the cost of each sequence at one of its steps."""
        costs = np.take_along_axis(self.stacked_costs(sequences), step[..., None, None], axis=2)[:, :, 0]
        return {name: costs[..., 1 + place] for place, name in enumerate(PARTS)}

    def plan(
        self,
        best: Sequences,
        costs: Float[np.ndarray, "b m"],
        progress: Sequence[Float[np.ndarray, " b"]],
        *,
        action: Float[np.ndarray, "b a"] | None = None,
        cheapest: Int[np.ndarray, "b m"] | None = None,
        memory: Sequences | None = None,
    ) -> Plan:
        """The plan that a search ends with.

        Args:
            best, costs: The best sequences, the best first.
            progress: The lowest cost known after each iteration.
            action: To be taken now; by default the first of the best sequence.
            cheapest: The step of each sequence that its cost is of; by default the one with the lowest cost.
            memory: To be given back at the next step.
        """
        parts = self.parts(best, self.costs(best).argmin(axis=2) if cheapest is None else cheapest)
        return Plan(
            action=best[:, 0, 0] if action is None else action,
            candidates=best,
            costs=costs,
            parts=parts,
            progress=np.stack(progress, axis=1),
            frames=self.frames,
            memory=memory,
        )
