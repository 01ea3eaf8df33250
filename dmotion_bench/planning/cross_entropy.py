"""The cross-entropy method over discrete actions (section III-C of the paper), and what later work adds to it.

The paper's: S sequences of H actions are drawn from a categorical distribution per step, at first uniform; the
distribution is set to the shares of the actions among the sequences with the lowest cost, and so on, lambda times.
A sequence costs the minimum over its steps. The first action of the best sequence that was ever drawn is taken.

The variations are those of iCEM (Pinneri et al. 2020, "Sample-efficient Cross-Entropy Method for Real-time
Planning"), carried over to discrete actions: correlated noise, which becomes a chance to repeat the action before;
elites that are kept from iteration to iteration; and the best sequences of the step before, shifted by one, among
the first candidates. All of them are off in the paper's setting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.futures import Futures
from dmotion_bench.planning.planner import SHOWN, Moment, Plan, best_first
from dmotion_bench.planning.tree import FutureTree


@dataclass(frozen=True, kw_only=True)
class CrossEntropyPlanner:
    """CEM; the defaults are the paper's.

    Attributes:
        samples: S, sequences drawn an iteration.
        horizon: H, actions in a sequence.
        iterations: lambda.
        elites: Sequences that the distribution is fitted to.
        stickiness: The chance that a sequence repeats its last action instead of drawing a new one, in the first
            iteration; it falls to zero in the last.
        kept: How many of the best sequences stay candidates at the next iteration and, shifted, at the next step.
        haste: Added to a step's cost, as a share of it, for each step before it: of two sequences that come equally
            near, the one that does so sooner is better.
    """

    samples: int = 50
    horizon: int = 5
    iterations: int = 4
    elites: int = 10
    stickiness: float = 0.0
    kept: int = 0
    haste: float = 0.0

    def __post_init__(self) -> None:
        for name in ("samples", "horizon", "iterations", "elites"):
            if getattr(self, name) < 1:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be 1 or more.")
        if self.elites > self.samples or self.kept > self.samples:
            raise InvalidSetting(
                f"elites is {self.elites} and kept {self.kept}; neither can be more than the {self.samples} samples."
            )
        if not 0 <= self.stickiness < 1:
            raise InvalidSetting(f"stickiness is {self.stickiness}; it is a chance from 0 to below 1.")

    def plan(self, futures: Futures, moment: Moment) -> Plan:
        """Draw sequences, compute their costs and refit the distribution, ``iterations`` times."""
        tree = FutureTree(futures, self.horizon)
        chance = np.full((futures.tasks, self.horizon, futures.actions), 1 / futures.actions)
        allowed = ~(moment.blocked & ~moment.blocked.all(axis=1, keepdims=True))
        best, price = _remembered(moment, tree, self)
        progress = []
        for iteration in range(self.iterations):
            sticky = self.stickiness * (1 - iteration / max(self.iterations - 1, 1))
            drawn = np.stack(
                [
                    draw(generator, own, first, self.samples, sticky)
                    for generator, own, first in zip(moment.generators, chance, allowed, strict=True)
                ]
            )
            costs = self._judged(tree.costs(drawn))
            kept = self.kept if iteration else best.shape[1]
            pool = np.concatenate([best[:, :kept], drawn], axis=1)
            worth = np.concatenate([price[:, :kept], costs], axis=1)
            elite = np.take_along_axis(pool, worth.argsort(axis=1, kind="stable")[:, : self.elites, None], axis=1)
            chance = (elite[..., None] == np.arange(futures.actions)).mean(axis=1)
            best, price = best_first(
                np.concatenate([best, drawn], axis=1),
                np.concatenate([price, costs], axis=1),
                max(SHOWN, self.kept),
            )
            progress.append(price[:, 0])
        return Plan(
            action=best[:, 0, 0],
            candidates=best[:, :SHOWN],
            costs=price[:, :SHOWN],
            progress=np.stack(progress, axis=1),
            frames=tree.frames,
            memory=best[:, : self.kept] if self.kept else None,
        )

    def _judged(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s"]:
        """The cost of each sequence, from the costs of its steps."""
        if self.haste:
            costs = costs * (1 + self.haste * np.arange(costs.shape[2]))
        lowest: Float[np.ndarray, "b s"] = costs.min(axis=2)
        return lowest


def draw(
    generator: np.random.Generator,
    chance: Float[np.ndarray, "t a"],
    first: Bool[np.ndarray, " a"],
    count: int,
    stickiness: float = 0.0,
) -> Int[np.ndarray, "s t"]:
    """Sequences whose steps are drawn from ``chance``, or, with the chance ``stickiness``, repeat the step before.

    The first action is one that ``first`` allows, unless ``chance`` gives it no such one.
    """
    allowed = chance[0] * first
    rows = np.concatenate([(allowed if allowed.any() else np.asarray(first, float))[None], chance[1:]])
    bounds = rows.cumsum(axis=1)
    fresh: Int[np.ndarray, "s t"] = (generator.random((count, len(rows), 1)) * bounds[:, -1:] >= bounds).sum(axis=2)
    if not stickiness:
        return fresh
    repeats = generator.random(fresh.shape) < stickiness
    repeats[:, 0] = False
    source = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(rows))), axis=1)
    return np.take_along_axis(fresh, source, axis=1)


def _remembered(
    moment: Moment, tree: FutureTree, planner: CrossEntropyPlanner
) -> tuple[Int[np.ndarray, "b m t"], Float[np.ndarray, "b m"]]:
    """The best sequences of the previous control step, shifted by one action, with the last action repeated."""
    tasks = len(moment.generators)
    if moment.memory is None or not planner.kept:
        return np.zeros((tasks, 0, planner.horizon), np.int64), np.zeros((tasks, 0))
    shifted = np.concatenate([moment.memory[:, :, 1:], moment.memory[:, :, -1:]], axis=2)
    costs = planner._judged(tree.costs(shifted))
    refused = np.take_along_axis(moment.blocked, shifted[:, :, 0], axis=1)
    return shifted, np.where(refused, np.inf, costs)
