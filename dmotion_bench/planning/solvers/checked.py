"""A solver whose plans are checked: what it returns, and that it raises nothing."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.errors import PlannerContractBroken
from dmotion_bench.planning.contract import calling
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Solver, are_within
from dmotion_bench.wording import shown


def checked_plan(solver: Solver, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
    """The plan of a solver, its action and its memory as arrays; arguments as of ``Solver.plan``.

    Its memory is what a journal gives back: in 64 bits, and None for one that holds no action.

    Raises:
        PlannerContractBroken: The solver raises an error, returns no plan, or no action for each task, counts frames
            that are no number of them, or remembers something else than sequences of actions.
    """
    with calling(solver, "plan"):
        plan: Any = solver.plan(dynamics, evaluator, context)
    if not isinstance(plan, Plan):
        raise PlannerContractBroken(f"the solver returns {shown(type(plan).__name__)}; it must return a Plan.")
    spec, tasks = dynamics.actions, len(context.generators)
    if not isinstance(plan.frames, int | np.integer) or plan.frames < 0:
        raise PlannerContractBroken(
            f"the solver says that it predicted {shown(plan.frames)} frames; it must be a whole number from 0 on."
        )
    return dataclasses.replace(
        plan,
        action=_action(plan.action, spec, tasks),
        frames=int(plan.frames),
        memory=_memory(plan.memory, spec, tasks),
    )


def _action(given: Any, spec: ActionSpec, tasks: int) -> Any:
    """The actions of a plan, one for each task: a number of a discrete one, or normalised numbers."""
    found = _array(given)
    if isinstance(spec, Discrete):
        fits = found.shape == (tasks,) and np.issubdtype(found.dtype, np.integer)
        fits = fits and bool(((found >= 0) & (found < len(spec))).all())
        wanted = f"{tasks} whole numbers from 0 to {len(spec) - 1}"
    else:
        fits = found.shape == (tasks, spec.width) and np.issubdtype(found.dtype, np.floating)
        fits = fits and are_within(found)
        wanted = f"{tasks} times {spec.width} numbers from -1 to 1"
    if not fits:
        raise PlannerContractBroken(
            f"the solver chooses the actions {shown(str(found.tolist()))}; it must be {wanted}."
        )
    return found


def _memory(given: Any, spec: ActionSpec, tasks: int) -> Any:
    """What a solver remembers: as many sequences of actions for each task, which a journal can keep."""
    if given is None:
        return None
    found, discrete = _array(given), isinstance(spec, Discrete)
    kind, axes = (np.integer, 3) if discrete else (np.floating, 4)
    if not (found.ndim == axes and len(found) == tasks and np.issubdtype(found.dtype, kind)):
        raise PlannerContractBroken(
            f"the solver remembers {shown(type(given).__name__)} of the shape {found.shape} and the type "
            f"{found.dtype}; it must be None or an array of sequences of actions, ({tasks}, sequences, "
            f"steps{'' if discrete else ', numbers'})."
        )
    if isinstance(spec, Discrete):
        wrong = found[(found < -1) | (found >= len(spec))]
        if wrong.size:
            raise PlannerContractBroken(
                f"the solver remembers the action {wrong[0]}; there are 0 to {len(spec) - 1}, and -1 for none."
            )
    elif found.shape[3] != spec.width:
        raise PlannerContractBroken(
            f"the solver remembers actions of {found.shape[3]} numbers; there are {spec.width} in each."
        )
    return found.astype(np.int64 if discrete else np.float64) if found.size else None


def _array(given: Any) -> Any:
    try:
        return np.asarray(given)
    except (ValueError, TypeError):  # lists of different lengths, or a tensor on another device
        return np.asarray(None)
