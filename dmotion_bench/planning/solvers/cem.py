"""The cross-entropy method (section III-C of the paper): a distribution is fitted to the best of its own samples.

S sequences of H actions are drawn, the distribution is fitted to those with the lowest cost, and so on, lambda times.
A sequence costs the minimum over its steps. The first action of the best sequence that was ever drawn is taken.

For discrete actions, the paper's, the distribution is categorical for each step, at first uniform, and is fitted by
setting it to the shares of the actions among the elites. For continuous actions it is a Gaussian for each number,
whose mean itself is among the samples of the last iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import SHOWN, Plan, PlanContext, Ranked, Sequences, best_first
from dmotion_bench.planning.solvers.proposals import Categorical, Gaussian, search, shifted
from dmotion_bench.planning.solvers.search import Search
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class CrossEntropy:
    """CEM; the defaults are the paper's.

    Attributes:
        samples: S, sequences drawn an iteration.
        horizon: H, actions in a sequence.
        iterations: lambda.
        elites: Sequences that the distribution is fitted to.
        action_repeat_prob: Of discrete actions: the probability that a sequence repeats its last action instead of
            drawing a new one, in the first iteration; it falls to zero in the last.
        kept_elites: How many of the best sequences stay candidates at the next iteration and, shifted, at the next
            step.
        step_discount: Added to a step's cost, as a share of it, for each step before it: of two sequences that come
            equally near, the one that does so sooner is better.
        initial_std: Of continuous actions in [-1, 1]: the standard deviation at first.
        noise_exponent: Of continuous actions: beta, by which the noise's power falls with frequency; 0 is white noise.
        momentum: Of continuous actions: the share of the distribution before that a fit keeps.
    """

    samples: int = 50
    horizon: int = 5
    iterations: int = 4
    elites: int = 10
    action_repeat_prob: float = 0.0
    kept_elites: int = 0
    step_discount: float = 0.0
    initial_std: float = 0.5
    noise_exponent: float = 0.0
    momentum: float = 0.0

    def __post_init__(self) -> None:
        require_bounds(
            self,
            from_one=("samples", "horizon", "iterations", "elites"),
            above_zero=("initial_std",),
            from_zero=("step_discount", "noise_exponent"),
            below_one=("action_repeat_prob", "momentum"),
        )
        if self.elites > self.samples or not 0 <= self.kept_elites <= self.samples:
            raise InvalidSetting(
                f"elites is {self.elites} and kept_elites {self.kept_elites}; neither can be more than the "
                f"{self.samples} samples, or below zero."
            )

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Draw sequences, compute their costs and refit the distribution, ``iterations`` times."""
        sought = search(dynamics, evaluator, context.observation, self.horizon)
        best, price = self._warm_start(dynamics, context, sought)
        proposal = self._proposal(dynamics, context, best)
        progress = []
        for iteration in range(self.iterations):
            drawn = proposal.draw(context.generators, self.samples, 1 - iteration / max(self.iterations - 1, 1))
            costs = self._of_sequences(sought.costs(drawn))
            kept = self.kept_elites if iteration else best.shape[1]
            pool = np.concatenate([best[:, :kept], drawn], axis=1)
            worth = np.concatenate([price[:, :kept], costs], axis=1)
            elite = worth.argsort(axis=1, kind="stable")[:, : self.elites]
            proposal = proposal.fitted(pool[np.arange(len(pool))[:, None], elite])
            best, price = best_first(drawn, costs, max(SHOWN, self.kept_elites), before=(best, price))
            progress.append(price[:, 0])
        shown = best[:, :SHOWN]
        return sought.plan(
            shown,
            price[:, :SHOWN],
            progress,
            cheapest=self._discounted(sought.costs(shown)).argmin(axis=2),
            memory=best[:, : self.kept_elites] if self.kept_elites else None,
        )

    def _proposal(self, dynamics: Dynamics, context: PlanContext, before: Sequences) -> Categorical | Gaussian:
        """The first distribution; of continuous actions its mean is that of the best sequences before."""
        actions = dynamics.actions
        if isinstance(actions, Discrete):
            return Categorical.uniform(len(actions), context.blocked, self.horizon, self.action_repeat_prob)
        shape = (len(context.generators), self.horizon, actions.width)
        return Gaussian(
            mean=before.mean(axis=1) if before.shape[1] else np.zeros(shape),
            std=np.full(shape, self.initial_std),
            exponent=self.noise_exponent,
            momentum=self.momentum,
        )

    def _of_sequences(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s"]:
        """The cost of each sequence, from the costs of its steps."""
        lowest: Float[np.ndarray, "b s"] = self._discounted(costs).min(axis=2)
        return lowest

    def _discounted(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s t"]:
        return costs * (1 + self.step_discount * np.arange(costs.shape[2])) if self.step_discount else costs

    def _warm_start(self, dynamics: Dynamics, context: PlanContext, sought: Search) -> Ranked:
        """The best sequences of the step before, shifted by one action, and what they cost now."""
        tasks, actions = len(context.generators), dynamics.actions
        if context.memory is None or not self.kept_elites:
            return np.zeros((tasks, 0, self.horizon, *actions.shape), actions.dtype), np.zeros((tasks, 0))
        before = shifted(context.memory)
        costs = self._of_sequences(sought.costs(before))
        if isinstance(actions, Continuous):
            return before, costs
        refused = np.take_along_axis(context.blocked, before[:, :, 0], axis=1)
        return before, np.where(refused, np.inf, costs)
