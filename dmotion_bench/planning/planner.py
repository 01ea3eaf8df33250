"""What a planner is, and the planners by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.errors import UnknownName
from dmotion_bench.planning.futures import Futures


@dataclass(frozen=True, kw_only=True)
class Moment:
    """The context of one planning step for some tasks, besides the predictions.

    Attributes:
        generators: Random numbers for each task, a function of the seed, the task and the step alone, so that tasks
            may be planned together or one by one.
        blocked: Actions that are not to be the first.
        memory: What the planner wanted to remember at the step before, None at the first.
    """

    generators: tuple[np.random.Generator, ...]
    blocked: Bool[np.ndarray, "b a"]
    memory: Int[np.ndarray, "b n t"] | None = None


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The result of planning one step.

    Attributes:
        action: The action to take now.
        candidates: The best sequences that were thought of, the best first.
        costs: Theirs; infinite where fewer were thought of.
        progress: The lowest cost known after each of the planner's iterations.
        frames: How many frames were imagined for all tasks together.
        memory: To be given back at the next step; None for planners that forget.
    """

    action: Int[np.ndarray, " b"]
    candidates: Int[np.ndarray, "b m t"]
    costs: Float[np.ndarray, "b m"]
    progress: Float[np.ndarray, "b i"]
    frames: int
    memory: Int[np.ndarray, "b n t"] | None = None


@runtime_checkable
class Planner(Protocol):
    """Chooses actions for several tasks at once, each independently of the others."""

    def plan(self, futures: Futures, moment: Moment) -> Plan:
        """Plan one step."""


SHOWN: Final = 5
"""How many of the best sequences a plan holds."""


def best_first(
    sequences: Int[np.ndarray, "b s t"], costs: Float[np.ndarray, "b s"], count: int
) -> tuple[Int[np.ndarray, "b m t"], Float[np.ndarray, "b m"]]:
    """The ``count`` cheapest distinct sequences of each task; the best is repeated if there are too few."""
    chosen, prices = [], []
    for own, price in zip(sequences, costs, strict=True):
        order, seen = [], set[bytes]()
        for index in price.argsort(kind="stable").tolist():
            if (name := own[index].tobytes()) not in seen:
                seen.add(name)
                order.append(index)
            if len(order) == count:
                break
        lacking = count - len(order)
        chosen.append(own[order + order[:1] * lacking])
        prices.append(np.concatenate([price[order], np.full(lacking, np.inf)]))
    return np.stack(chosen), np.stack(prices)


DEFAULT_PLANNER = "cem"


def _planners() -> Mapping[str, Callable[[], Planner]]:
    from dmotion_bench.planning.cross_entropy import CrossEntropyPlanner
    from dmotion_bench.planning.exhaustive import ExhaustivePlanner

    return MappingProxyType(
        {
            "cem": CrossEntropyPlanner,
            "icem": partial(CrossEntropyPlanner, stickiness=0.6, kept=5),
            "exhaustive": ExhaustivePlanner,
        }
    )


def planner_names() -> list[str]:
    """The names that ``--planner`` accepts."""
    return list(_planners())


def make_planner(name: str) -> Planner:
    """A planner by its name.

    Raises:
        UnknownName: There is none of this name.
    """
    known = _planners()
    if name not in known:
        raise UnknownName("planner", name, known)
    return known[name]()
