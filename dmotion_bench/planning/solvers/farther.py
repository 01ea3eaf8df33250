"""iCEM that looks farther where nothing near helps.

What is out of reach within the horizon costs the same whatever is done, so no plan is better than another. Then twice
as many steps are looked ahead and each chosen action is held for twice as long; then four times. So as many choices
reach farther, and a model's mistakes over many steps count only where few steps promise nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext
from dmotion_bench.planning.solvers.icem import ImprovedCrossEntropy
from dmotion_bench.planning.solvers.proposals import Categorical, Gaussian, search
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class FartherCrossEntropy(ImprovedCrossEntropy):
    """iCEM with several horizons; in each task the next one is tried as long as no plan gains enough.

    A plan's gain is the share that it saves of what single actions leave the cost at, by their median.

    Attributes:
        scales: How many horizons: ``horizon`` steps, twice as many, four times, ...; actions are held likewise.
        least_gain: What a plan must gain.
    """

    scales: int = 3
    least_gain: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        require_bounds(self, from_one=("scales",), from_zero=("least_gain",), below_one=("least_gain",))

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """Search within the horizon, and farther for tasks where that gains too little.

        The candidates that are shown are cut off at ``horizon``.
        """
        tasks = len(context.generators)
        plan = self._within(1, np.ones(tasks, np.bool_), dynamics, evaluator, context)
        if not plan.frames:  # an earlier plan is carried out
            return plan
        near = search(dynamics, evaluator, context.observation, 1)
        left = np.median(near.costs(_single_actions(dynamics.actions, tasks))[:, :, 0], axis=1)
        enough = (1 - self.least_gain) * left
        plan = replace(plan, frames=plan.frames + near.frames)
        for power in range(1, self.scales):
            stuck = plan.costs[:, 0] > enough
            if not stuck.any():
                break
            far = self._within(2**power, stuck, dynamics, evaluator, context)
            plan = _exchanged(plan, far, stuck & (far.costs[:, 0] <= enough))
        return plan

    def _within(
        self,
        scale: int,
        searching: Bool[np.ndarray, " b"],
        dynamics: Dynamics,
        evaluator: Evaluator,
        context: PlanContext,
    ) -> Plan:
        """The plan of one horizon, for the tasks that search; its memory is as long as the longest horizon."""
        own = {one.name: getattr(self, one.name) for one in fields(ImprovedCrossEntropy)}
        own |= {"horizon": self.horizon * scale, "hold": self.hold * scale}
        solver = _CrossEntropyOfSome(**own, searching=searching)
        if context.memory is not None:
            context = replace(context, memory=context.memory[:, :, : solver.horizon])
        plan = solver.plan(dynamics, evaluator, context)
        memory = plan.memory
        if memory is not None:
            lacking = self.horizon * 2 ** (self.scales - 1) - memory.shape[2]
            memory = np.concatenate([memory, memory[:, :, -1:].repeat(lacking, axis=2)], axis=2)
        return replace(plan, candidates=plan.candidates[:, :, : self.horizon], memory=memory)


@dataclass(frozen=True, kw_only=True)
class _CrossEntropyOfSome(ImprovedCrossEntropy):
    """iCEM for some of the tasks; of the others one sequence is predicted.

    Attributes:
        searching: Whether each task is searched.
    """

    searching: Any = field(compare=False)

    def _drawn(self, proposal: Categorical | Gaussian, context: PlanContext, heat: float) -> Any:
        drawn = super()._drawn(proposal, context, heat)
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
    """A plan with another one in its place for the chosen tasks."""

    def mixed(one: Any, two: Any) -> Any:
        return np.where(chosen.reshape(-1, *(1,) * (one.ndim - 1)), two, one)

    return replace(
        plan,
        **{
            name: mixed(getattr(plan, name), getattr(other, name))
            for name in ("action", "candidates", "costs", "progress")
        },
        parts={name: mixed(part, other.parts[name]) for name, part in plan.parts.items()},
        memory=None if plan.memory is None else mixed(plan.memory, other.memory),
        frames=plan.frames + other.frames,
    )
