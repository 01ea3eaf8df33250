"""The cross-entropy method (section III-C of the paper): a distribution is fitted to the best of its own samples.

For discrete actions: S sequences of H actions are drawn from a categorical distribution per step, at first uniform;
the distribution is set to the shares of the actions among the sequences with the lowest cost, and so on, lambda
times. A sequence costs the minimum over its steps. The first action of the best sequence that was ever drawn is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.dynamics.prefix_tree import PrefixTree
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import SHOWN, Plan, PlanContext, best_first


@dataclass(frozen=True, kw_only=True)
class CrossEntropy:
    """CEM; the defaults are the paper's.

    Attributes:
        samples: S, sequences drawn an iteration.
        horizon: H, actions in a sequence.
        iterations: lambda.
        elites: Sequences that the distribution is fitted to.
        action_repeat_prob: The probability that a sequence repeats its last action instead of drawing a new one, in
            the first iteration; it falls to zero in the last.
        kept_elites: How many of the best sequences stay candidates at the next iteration and, shifted, at the next
            step.
        step_discount: Added to a step's cost, as a share of it, for each step before it: of two sequences that come
            equally near, the one that does so sooner is better.
    """

    samples: int = 50
    horizon: int = 5
    iterations: int = 4
    elites: int = 10
    action_repeat_prob: float = 0.0
    kept_elites: int = 0
    step_discount: float = 0.0

    def __post_init__(self) -> None:
        for name in ("samples", "horizon", "iterations", "elites"):
            if getattr(self, name) < 1:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be 1 or more.")
        if self.elites > self.samples or not 0 <= self.kept_elites <= self.samples:
            raise InvalidSetting(
                f"elites is {self.elites} and kept_elites {self.kept_elites}; neither can be more than the "
                f"{self.samples} samples, or below zero."
            )
        if not 0 <= self.action_repeat_prob < 1:
            raise InvalidSetting(f"action_repeat_prob is {self.action_repeat_prob}; it must be in [0, 1).")
        if self.step_discount < 0:
            raise InvalidSetting(f"step_discount is {self.step_discount}; it cannot be below zero.")

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Draw sequences, compute their costs and refit the distribution, ``iterations`` times."""
        tree = PrefixTree(dynamics, evaluator, context.observation, self.horizon)
        tasks = len(context.generators)
        chance = np.full((tasks, self.horizon, tree.actions), 1 / tree.actions)
        allowed = ~(context.blocked & ~context.blocked.all(axis=1, keepdims=True))
        best, price = self._warm_start(context, tree)
        progress = []
        for iteration in range(self.iterations):
            repeat = self.action_repeat_prob * (1 - iteration / max(self.iterations - 1, 1))
            drawn = np.stack(
                [
                    draw(generator, own, first, self.samples, repeat)
                    for generator, own, first in zip(context.generators, chance, allowed, strict=True)
                ]
            )
            costs = self._of_sequences(tree.costs(drawn))
            kept = self.kept_elites if iteration else best.shape[1]
            pool = np.concatenate([best[:, :kept], drawn], axis=1)
            worth = np.concatenate([price[:, :kept], costs], axis=1)
            elite = np.take_along_axis(pool, worth.argsort(axis=1, kind="stable")[:, : self.elites, None], axis=1)
            chance = (elite[..., None] == np.arange(tree.actions)).mean(axis=1)
            best, price = best_first(
                np.concatenate([best, drawn], axis=1),
                np.concatenate([price, costs], axis=1),
                max(SHOWN, self.kept_elites),
            )
            progress.append(price[:, 0])
        shown = best[:, :SHOWN]
        return Plan(
            action=best[:, 0, 0],
            candidates=shown,
            costs=price[:, :SHOWN],
            parts=tree.parts(shown, self._discounted(tree.costs(shown)).argmin(axis=2)),
            progress=np.stack(progress, axis=1),
            frames=tree.frames,
            memory=best[:, : self.kept_elites] if self.kept_elites else None,
        )

    def _of_sequences(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s"]:
        """The cost of each sequence, from the costs of its steps."""
        lowest: Float[np.ndarray, "b s"] = self._discounted(costs).min(axis=2)
        return lowest

    def _discounted(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s t"]:
        return costs * (1 + self.step_discount * np.arange(costs.shape[2])) if self.step_discount else costs

    def _warm_start(
        self, context: PlanContext, tree: PrefixTree
    ) -> tuple[Int[np.ndarray, "b m t"], Float[np.ndarray, "b m"]]:
        """The best sequences of the step before, shifted by one action, with the last action repeated."""
        tasks = len(context.generators)
        if context.memory is None or not self.kept_elites:
            return np.zeros((tasks, 0, self.horizon), np.int64), np.zeros((tasks, 0))
        shifted = np.concatenate([context.memory[:, :, 1:], context.memory[:, :, -1:]], axis=2)
        costs = self._of_sequences(tree.costs(shifted))
        refused = np.take_along_axis(context.blocked, shifted[:, :, 0], axis=1)
        return shifted, np.where(refused, np.inf, costs)


def draw(
    generator: np.random.Generator,
    chance: Float[np.ndarray, "t a"],
    first: Bool[np.ndarray, " a"],
    count: int,
    repeat: float = 0.0,
) -> Int[np.ndarray, "s t"]:
    """Sequences whose steps are drawn from ``chance``, or, with the probability ``repeat``, repeat the step before.

    The first action is one that ``first`` allows, unless ``chance`` gives it no such one.
    """
    allowed = chance[0] * first
    rows = np.concatenate([(allowed if allowed.any() else np.asarray(first, float))[None], chance[1:]])
    bounds = rows.cumsum(axis=1)
    fresh: Int[np.ndarray, "s t"] = (generator.random((count, len(rows), 1)) * bounds[:, -1:] >= bounds).sum(axis=2)
    if not repeat:
        return fresh
    repeats = generator.random(fresh.shape) < repeat
    repeats[:, 0] = False
    source = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(rows))), axis=1)
    return np.take_along_axis(fresh, source, axis=1)
