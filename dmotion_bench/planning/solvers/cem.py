"""The cross-entropy method (section III-C of the paper): a distribution is fitted to the best of its own samples.

S sequences of H actions are drawn, the distribution is fitted to those with the lowest cost, and so on, lambda times.
A sequence costs the minimum over its steps, or what ``cost_at`` says. The first action of the best sequence that was
ever drawn is taken.

For discrete actions, the paper's, the distribution is categorical for each step, at first uniform, and is fitted by
setting it to the shares of the actions among the elites. For continuous actions it is a Gaussian for each number. In
the last of several iterations its mean itself is among the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.settings import only_for
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import SHOWN, Plan, PlanContext, Ranked, Sequences, best_first
from dmotion_bench.planning.solvers.proposals import Categorical, Gaussian, carried_on, search, shifted
from dmotion_bench.planning.solvers.search import Search
from dmotion_bench.values import require_bounds

CostAt = Literal["best", "last", "sum"]
"""Which steps of a sequence its cost is of: the cheapest one, the last one, or all together."""


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
            equally near, the one that does so sooner is better. A cost below zero is divided by the same factor, so
            that it, too, is worth less the later it is reached.
        cost_at: Which steps a sequence's cost is of: ``"best"``, ``"last"``, or ``"sum"`` of all.
        hold: Steps that each drawn action is held for: with 3 a sequence of 15 actions has five to choose. What is
            taken over to the next step, the mean and the elites, is read from its first action there, so it hardly
            moves on; a frozen column plans in this way.
        replan_every: Actions of a plan that are carried out before the next search; the paper's 1 searches at every
            step. Nothing is predicted at the steps between.
        initial_std: Of continuous actions in [-1, 1]: the standard deviation at first.
        noise_exponent: Of continuous actions: beta, by which the noise's power falls with frequency; 0 is white noise.
        momentum: Of continuous actions: the share of the distribution before that a fit keeps.
    """

    samples: int = 50
    horizon: int = 5
    iterations: int = 4
    elites: int = 10
    action_repeat_prob: float = only_for(0.0, Discrete)
    kept_elites: int = 0
    step_discount: float = 0.0
    cost_at: CostAt = "best"
    hold: int = 1
    replan_every: int = 1
    initial_std: float = only_for(0.5, Continuous)
    noise_exponent: float = only_for(0.0, Continuous)
    momentum: float = only_for(0.0, Continuous)

    def __post_init__(self) -> None:
        require_bounds(
            self,
            from_one=("samples", "horizon", "iterations", "elites", "hold", "replan_every"),
            above_zero=("initial_std",),
            from_zero=("step_discount", "noise_exponent"),
            below_one=("action_repeat_prob", "momentum"),
        )
        if self.elites > self.samples or not 0 <= self.kept_elites <= self.samples:
            raise InvalidSetting(
                f"elites is {self.elites} and kept_elites {self.kept_elites}; neither can be more than the "
                f"{self.samples} samples, or below zero."
            )
        if self.replan_every > self.horizon:
            raise InvalidSetting(
                f"replan_every is {self.replan_every}, and a plan has {self.horizon} actions (horizon); carry out as "
                "many or fewer."
            )
        if self.cost_at not in get_args(CostAt):
            raise InvalidSetting(f"cost_at is {self.cost_at!r}; it can be {', '.join(get_args(CostAt))}.")

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Draw sequences, compute their costs and refit the distribution, ``iterations`` times; or carry on a plan."""
        if context.memory is not None and context.observation.step % self.replan_every:
            return self._carried_on(context.memory)
        sought = search(dynamics, evaluator, context.observation, self._farthest)
        return self._planned(sought, dynamics, context)

    def _carried_on(self, memory: Any) -> Plan:
        """The plan of the step before, one action on."""
        return carried_on(memory)

    @property
    def _farthest(self) -> int:
        """Steps that the search looks ahead at most."""
        return self.horizon

    def _planned(self, sought: Search, dynamics: Dynamics, context: PlanContext) -> Plan:
        """The plan that a search comes to."""
        best, best_costs = self._warm_start(dynamics, context, sought)
        proposal = self._proposal(dynamics, context, best)
        progress = []
        for iteration in range(self.iterations):
            temperature = 1 - iteration / max(self.iterations - 1, 1)
            drawn = self._held(proposal.draw(context.generators, self.samples, temperature))
            costs = self._of_sequences(sought.costs(drawn))
            kept = self.kept_elites if iteration else best.shape[1]
            pool = np.concatenate([best[:, :kept], drawn], axis=1)
            pool_costs = np.concatenate([best_costs[:, :kept], costs], axis=1)
            elite = pool_costs.argsort(axis=1, kind="stable")[:, : self.elites]
            proposal = proposal.fitted(pool[np.arange(len(pool))[:, None], elite][:, :, :: self.hold])
            best, best_costs = best_first(drawn, costs, max(SHOWN, self.kept_elites), before=(best, best_costs))
            progress.append(best_costs[:, 0])
        shown = best[:, :SHOWN]
        return sought.plan(
            shown,
            best_costs[:, :SHOWN],
            progress,
            cheapest=self._step_of(sought.costs(shown)),
            memory=best[:, : max(1, self.kept_elites)] if self.kept_elites or self.replan_every > 1 else None,
        )

    def _proposal(self, dynamics: Dynamics, context: PlanContext, before: Sequences) -> Categorical | Gaussian:
        """The first distribution; of continuous actions its mean is that of the best sequences before."""
        actions, choices = dynamics.actions, -(-self.horizon // self.hold)
        if isinstance(actions, Discrete):
            return Categorical.uniform(len(actions), context.blocked, choices, self.action_repeat_prob)
        shape = (len(context.generators), choices, actions.width)
        return Gaussian(
            mean=before[:, :, :: self.hold].mean(axis=1) if before.shape[1] else np.zeros(shape),
            std=np.full(shape, self.initial_std),
            exponent=self.noise_exponent,
            momentum=self.momentum,
        )

    def _of_sequences(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s"]:
        """The cost of each sequence, from the costs of its steps."""
        costs = self._discounted(costs)
        found: Float[np.ndarray, "b s"]
        match self.cost_at:
            case "best":
                found = costs.min(axis=2)
            case "last":
                found = costs[:, :, -1]
            case "sum":
                found = costs.sum(axis=2)
        return found

    def _step_of(self, costs: Float[np.ndarray, "b s t"]) -> Int[np.ndarray, "b s"]:
        """The step of each sequence whose parts of the cost are shown: the one it is judged by, of a sum the last."""
        if self.cost_at != "best":
            return np.full(costs.shape[:2], costs.shape[2] - 1)
        cheapest: Int[np.ndarray, "b s"] = self._discounted(costs).argmin(axis=2)
        return cheapest

    def _held(self, chosen: Any) -> Any:
        """Sequences in which each chosen action is held; the steps are the third axis."""
        return chosen if self.hold == 1 else chosen.repeat(self.hold, axis=2)[:, :, : self.horizon]

    def _discounted(self, costs: Float[np.ndarray, "b s t"]) -> Float[np.ndarray, "b s t"]:
        if not self.step_discount:
            return costs
        factor = 1 + self.step_discount * np.arange(costs.shape[2])
        discounted: Float[np.ndarray, "b s t"] = np.where(costs < 0, costs / factor, costs * factor)
        return discounted

    def _warm_start(self, dynamics: Dynamics, context: PlanContext, sought: Search) -> Ranked:
        """The best sequences of the step before, shifted by one action, and what they cost now."""
        tasks, actions = len(context.generators), dynamics.actions
        if context.memory is None or not self.kept_elites:
            return np.zeros((tasks, 0, self.horizon, *actions.shape), actions.dtype), np.zeros((tasks, 0))
        before = shifted(context.memory)[:, : self.kept_elites]
        costs = self._of_sequences(sought.costs(before))
        if isinstance(actions, Continuous):
            return before, costs
        refused = np.take_along_axis(context.blocked, before[:, :, 0], axis=1)
        return before, np.where(refused, np.inf, costs)
