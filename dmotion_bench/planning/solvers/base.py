"""What a solver is: it searches for the actions of which a dynamics and an objective say that they lead to the goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.planning.dynamics.base import Dynamics, Observation
from dmotion_bench.planning.experience import Experience
from dmotion_bench.planning.objectives.base import Evaluator

Sequences = Int[np.ndarray, "b _s t"] | Float[np.ndarray, "b _s t a"]
"""Some sequences of actions for each task: of numbers, or of continuous actions in [-1, 1]; any number of them."""

Remembered = Int[np.ndarray, "b _s _t"] | Float[np.ndarray, "b _s _t a"]
"""Such sequences, which may be longer than others."""


ROUNDING: Final = 1e-6
"""By how much a number of a continuous action may lie beyond [-1, 1]."""


def are_within(actions: Float[np.ndarray, "*b a"]) -> bool:
    """Whether all continuous actions are in [-1, 1], but for rounding; one that is no number is not."""
    return bool((np.abs(actions) <= 1 + ROUNDING).all())


@dataclass(frozen=True, kw_only=True)
class PlanContext:
    """The context of one planning step for some tasks.

    Attributes:
        observation: What is seen of them.
        generators: Random numbers for each task, a function of the seed, the task and the step alone, so that tasks
            may be planned together or one by one.
        blocked: Actions that are not to be the first: they left the image as it is, since it last changed. None of
            continuous ones, where it has no columns.
        memory: What the solver wanted to remember at the step before, None at the first.
        experience: What was seen to follow what in each task until now; None where nobody keeps it.
    """

    observation: Observation
    generators: tuple[np.random.Generator, ...]
    blocked: Bool[np.ndarray, "b discrete"]
    memory: Remembered | None = None
    experience: Experience | None = None


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The result of planning one step; continuous actions are in [-1, 1].

    Attributes:
        action: The action to take now.
        candidates: The best sequences that were thought of, the best first.
        costs: Theirs; infinite where fewer were thought of, NaN where the rest of an earlier plan is carried out.
        parts: The parts of each cost (``objectives.base.PARTS``), at the sequence's cheapest step.
        progress: The lowest cost known after each of the solver's iterations.
        frames: How many frames were predicted for all tasks together.
        memory: To be given back at the next step; None for solvers that forget.
    """

    action: Int[np.ndarray, " b"] | Float[np.ndarray, "b a"]
    candidates: Sequences
    costs: Float[np.ndarray, "b m"]
    progress: Float[np.ndarray, "b i"]
    frames: int
    memory: Remembered | None = None
    parts: Mapping[str, Float[np.ndarray, "b m"]] = field(default_factory=dict)


@runtime_checkable
class Solver(Protocol):
    """Chooses actions for several tasks at once, each independently of the others.

    A solver is a frozen dataclass, complete when constructed: its fields are its settings.
    """

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Plan one step."""


@runtime_checkable
class LooksAtFrames(Protocol):
    """A solver that may look at imagined frames itself, whatever its objective does.

    Attributes:
        looks_at_frames: Whether it does: then the true simulator keeps what is seen.
    """

    looks_at_frames: ClassVar[bool]


SHOWN: Final = 5
"""How many of the best sequences a plan holds."""


Ranked = tuple[Sequences, Float[np.ndarray, "b _s"]]
"""Sequences and what they cost, the cheapest first."""


def best_first(
    sequences: Sequences, costs: Float[np.ndarray, "b s"], count: int = SHOWN, *, before: Ranked | None = None
) -> Ranked:
    """The ``count`` cheapest distinct sequences of each task; the best is repeated if there are too few.

    Args:
        sequences, costs: To choose from.
        count: How many are wanted.
        before: Chosen earlier, and to be chosen from as well.
    """
    if before is not None:
        sequences, costs = (np.concatenate(both, axis=1) for both in zip(before, (sequences, costs), strict=True))
    chosen, their_costs = [], []
    for own, own_costs in zip(sequences, costs, strict=True):
        order, seen = [], set[bytes]()
        for index in own_costs.argsort(kind="stable").tolist():
            if (name := own[index].tobytes()) not in seen:
                seen.add(name)
                order.append(index)
            if len(order) == count:
                break
        lacking = count - len(order)
        chosen.append(own[order + order[:1] * lacking])
        their_costs.append(np.concatenate([own_costs[order], np.full(lacking, np.inf)]))
    return np.stack(chosen), np.stack(their_costs)
