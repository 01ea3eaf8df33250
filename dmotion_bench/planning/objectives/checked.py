"""An objective whose methods are checked as they are called: what it returns, and that it raises nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Int, UInt8
from torch import Tensor

from dmotion_bench.planning.contract import calling, require
from dmotion_bench.planning.dynamics.base import Actions, Dynamics, State
from dmotion_bench.planning.objectives.base import PARTS, CostState, Evaluator, Objective, StepCost, Taken
from dmotion_bench.specs import EnvSpec
from dmotion_bench.wording import shown


def checked_reset(
    objective: Objective, spec: EnvSpec, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]
) -> CheckedEvaluator:
    """Begin some tasks by an objective; arguments as of ``Objective.reset``.

    Raises:
        PlannerContractBroken: It raises an error, or returns no evaluator. So do the evaluator's methods.
    """
    with calling(objective, "reset"):
        evaluator = objective.reset(spec, first, goals)
    lacking = [name for name in ("observe", "begin", "step") if not callable(getattr(evaluator, name, None))]
    require(
        objective,
        "reset",
        not lacking,
        f"returned {_described(evaluator)}, which has no {' and no '.join(lacking)}; it must return an evaluator",
    )
    return CheckedEvaluator(evaluator)


class CheckedEvaluator:
    """An evaluator that says which method of another one broke the contract.

    Args:
        evaluator: The other one.

    Attributes:
        checked: The evaluator whose methods are checked.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self.checked = evaluator

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """What was really done, and what is seen after it."""
        with calling(self.checked, "observe"):
            self.checked.observe(actions, frames)

    def begin(self, dynamics: Dynamics) -> CostState:
        """What the predictions of a control step start from."""
        with calling(self.checked, "begin"):
            carried = self.checked.begin(dynamics)
        self._require_carried("begin", carried)
        return carried

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Actions, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """What predicted states cost."""
        with calling(self.checked, "step"):
            found: Any = self.checked.step(dynamics, state, task, action, cost_state)
        pair = isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], StepCost)
        require(
            self.checked,
            "step",
            pair,
            f"returned {_described(found)}; it must return a StepCost and a tuple of tensors",
        )
        cost, carried = found
        for name in (*PARTS, "total"):
            part = getattr(cost, name)
            require(
                self.checked,
                "step",
                isinstance(part, Tensor) and part.shape == (len(task),),
                f"returned the {name} as {_described(part)}; it must be a tensor of the shape ({len(task)},), a number "
                "for each state",
            )
        self._require_carried("step", carried)
        return cost, carried

    def _require_carried(self, method: str, carried: object) -> None:
        tensors = isinstance(carried, tuple | list) and all(isinstance(one, Tensor) for one in carried)
        told = f"returned {_described(carried)} to carry on; it must be a tuple of tensors, empty for none"
        require(self.checked, method, tensors, told)


def _described(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"a tensor of the shape {tuple(value.shape)}"
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}"
    return shown(value) if value is None or isinstance(value, int | float) else f"a {type(value).__name__}"
