"""A solver whose plans are checked: what it returns, and that it raises nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
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
    """The plan of a solver, all that it holds as arrays; arguments as of ``Solver.plan``.

    Its memory is what a journal gives back: in 64 bits, and None for one that holds no action.

    Raises:
        PlannerContractBroken: The solver raises an error, returns no plan, or no action for each task, counts frames
            that are no number of them, remembers something else than sequences of actions, or shows candidates that
            are none, or costs that are not theirs.
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
    if not isinstance(plan.parts, Mapping):
        raise PlannerContractBroken(
            f"the solver's plan holds as the parts of its costs {shown(type(plan.parts).__name__)}; it must be a "
            "dictionary, empty for none."
        )
    action, candidates = _action(plan.action, spec, tasks), _candidates(plan.candidates, spec, tasks)
    costs = _numbers("costs", plan.costs, (tasks, candidates.shape[1]))
    if plan.frames and np.isnan(costs).any():  # of a plan that is carried on without predictions nothing is known
        raise PlannerContractBroken("the solver's plan holds costs that are not numbers (NaN).")
    return dataclasses.replace(
        plan,
        action=action,
        candidates=candidates,
        costs=costs,
        parts={name: _numbers(f"part {name!r} of the costs", part, costs.shape) for name, part in plan.parts.items()},
        progress=_numbers("progress", plan.progress, (tasks, None)),
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


def _candidates(given: Any, spec: ActionSpec, tasks: int) -> Any:
    """The best sequences of a plan: one at least for each task, of actions that exist."""
    found = _array(given)
    if isinstance(spec, Discrete):
        fits = found.ndim == 3 and np.issubdtype(found.dtype, np.integer)
        fits = fits and bool(((found >= 0) & (found < len(spec))).all())
        wanted = f"({tasks}, sequences, steps), whole numbers from 0 to {len(spec) - 1}"
    else:
        fits = found.ndim == 4 and np.issubdtype(found.dtype, np.floating) and found.shape[3] == spec.width
        fits = fits and are_within(found)
        wanted = f"({tasks}, sequences, steps, {spec.width}), numbers from -1 to 1"
    if not (fits and len(found) == tasks and found.size):
        raise PlannerContractBroken(
            f"the solver's plan holds the candidates {shown(str(found.tolist()))}; they must be an array of the shape "
            f"{wanted}."
        )
    return found


def _numbers(what: str, given: Any, shape: tuple[int, int | None]) -> Any:
    """Numbers of a plan, a row for each task; with None as many in each as there are."""
    found = _array(given)
    fits = found.ndim == 2 and found.dtype.kind in "fiu" and len(found) == shape[0]
    if not (fits and shape[1] in (None, found.shape[1])):
        wanted = f"({shape[0]}, {'any number' if shape[1] is None else shape[1]})"
        raise PlannerContractBroken(
            f"the solver's plan holds as its {what} {found.dtype} of the shape {found.shape}; it must be numbers of "
            f"the shape {wanted}, a row for each task."
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
