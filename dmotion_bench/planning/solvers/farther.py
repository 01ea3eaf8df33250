"""iCEM that looks farther where nothing near helps.

What is out of reach within the horizon costs the same whatever is done, so no plan is better than another. Then twice
as many steps are looked ahead and each chosen action is held for twice as long; then four times. So as many choices
reach farther, and a model's mistakes over many steps count only where few steps promise nothing. Such searches are
dear, and most are in vain, so they are made every few steps; a long plan that was found is carried on between them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.solvers.base import Plan, PlanContext
from dmotion_bench.planning.solvers.icem import ImprovedCrossEntropy
from dmotion_bench.planning.solvers.proposals import Categorical, Gaussian
from dmotion_bench.planning.solvers.search import Search
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class FartherCrossEntropy(ImprovedCrossEntropy):
    """iCEM with several horizons; in each task the next one is tried as long as no plan gains enough.

    A plan's gain is the share that it saves of what single actions leave the cost at, by their median.

    Attributes:
        scales: How many horizons: ``horizon`` steps, twice as many, four times, ...; actions are held likewise.
        least_gain: What a plan must gain.
        farther_every: Steps from one search with longer horizons to the next; between them the best sequence of the
            step before, as long as the longest horizon, is tried where near plans do not gain enough. It is known if
            ``kept_elites`` is not 0.
    """

    scales: int = 3
    least_gain: float = 0.05
    farther_every: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        require_bounds(self, from_one=("scales", "farther_every"), from_zero=("least_gain",), below_one=("least_gain",))

    @property
    def _farthest(self) -> int:
        steps: int = self.horizon * 2 ** (self.scales - 1)
        return steps

    def _planned(self, sought: Search, dynamics: Dynamics, context: PlanContext) -> Plan:
        """The plan of the nearest horizon that gains enough; the candidates that are shown are cut off at ``horizon``.

        All horizons share their predictions.
        """
        tasks = len(context.generators)
        plan = self._within(1, np.ones(tasks, np.bool_), sought, dynamics, context)
        left = np.median(sought.costs(_single_actions(dynamics.actions, tasks))[:, :, 0], axis=1)
        enough = (1 - self.least_gain) * left
        plan = self._carried_farther(plan, enough, sought, dynamics, context)
        if not context.observation.step % self.farther_every:
            for power in range(1, self.scales):
                stuck = plan.costs[:, 0] > enough
                if not stuck.any():
                    break
                far = self._within(2**power, stuck, sought, dynamics, context)
                plan = _exchanged(plan, far, stuck & (far.costs[:, 0] <= enough))
        return replace(plan, candidates=plan.candidates[:, :, : self.horizon], frames=sought.frames)

    def _carried_farther(
        self, plan: Plan, enough: Float[np.ndarray, " b"], sought: Search, dynamics: Dynamics, context: PlanContext
    ) -> Plan:
        """A plan with the best long sequence of the step before in its place, in tasks where only that gains enough."""
        stuck = plan.costs[:, 0] > enough
        if context.memory is None or not self.kept_elites or not stuck.any():
            return plan
        known = np.where(_beside(stuck, context.memory), context.memory, 0)[:, :1]
        best, costs = self._warm_start(dynamics, replace(context, memory=known), sought)
        carried = sought.plan(best, costs, [costs[:, 0]], cheapest=self._step_of(sought.costs(best)), memory=best)
        return _exchanged(plan, carried, stuck & (costs[:, 0] <= enough))

    def _within(
        self, scale: int, searching: Bool[np.ndarray, " b"], sought: Search, dynamics: Dynamics, context: PlanContext
    ) -> Plan:
        """The plan of one horizon, for the tasks that search."""
        own = {one.name: getattr(self, one.name) for one in fields(ImprovedCrossEntropy)}
        own |= {"horizon": self.horizon * scale, "hold": self.hold * scale}
        solver = _CrossEntropyOfSome(**own, searching=searching)
        if context.memory is not None:
            context = replace(context, memory=context.memory[:, :, : solver.horizon])
        plan = solver._planned(sought, dynamics, context)
        memory = None if plan.memory is None else self._lengthened(plan.memory)
        return replace(plan, candidates=self._lengthened(plan.candidates), memory=memory)

    def _lengthened(self, sequences: Any) -> Any:
        """Sequences as long as the farthest horizon, with the last action repeated."""
        lacking = self._farthest - sequences.shape[2]
        return np.concatenate([sequences, sequences[:, :, -1:].repeat(lacking, axis=2)], axis=2)


@dataclass(frozen=True, kw_only=True)
class _CrossEntropyOfSome(ImprovedCrossEntropy):
    """iCEM for some of the tasks; of the others one sequence is predicted.

    Attributes:
        searching: Whether each task is searched.
    """

    searching: Any

    def _drawn(self, proposal: Categorical | Gaussian, context: PlanContext, temperature: float) -> Any:
        drawn = super()._drawn(proposal, context, temperature)
        drawn[~self.searching] = 0
        return drawn


def _single_actions(spec: ActionSpec, tasks: int) -> Any:
    """Sequences of one action for each task: every discrete one, or of continuous ones each number's two bounds."""
    if isinstance(spec, Discrete):
        each: Any = np.arange(len(spec))
    else:
        each = np.concatenate([np.eye(spec.width), -np.eye(spec.width)])
    return np.broadcast_to(each[:, None], (tasks, len(each), 1, *spec.shape))


def _exchanged(plan: Plan, other: Plan, chosen: Bool[np.ndarray, " b"]) -> Plan:
    """A plan with another one in its place for the chosen tasks; of one candidate, it fills all places."""

    def mixed(one: Any, two: Any) -> Any:
        return np.where(_beside(chosen, one), two, one)

    return replace(
        plan,
        **{
            name: mixed(getattr(plan, name), getattr(other, name))
            for name in ("action", "candidates", "costs", "progress")
        },
        parts={name: mixed(part, other.parts[name]) for name, part in plan.parts.items()},
        memory=None if plan.memory is None else mixed(plan.memory, other.memory),
    )


def _beside(tasks: Bool[np.ndarray, " b"], array: Any) -> Bool[np.ndarray, "b *_ones"]:
    """A truth for each task, in the shape that fits beside an array with a row for each."""
    return tasks.reshape(-1, *(1,) * (array.ndim - 1))
