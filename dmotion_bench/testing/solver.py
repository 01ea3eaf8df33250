"""Whether a solver keeps the contract of ``planning/solvers/base.py``."""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.contract import require
from dmotion_bench.planning.dynamics.base import Actions, Dynamics, Observation, State
from dmotion_bench.planning.experience import Experience
from dmotion_bench.planning.objectives.base import CostState, Memoryless, StepCost
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Solver
from dmotion_bench.planning.solvers.checked import checked_plan
from dmotion_bench.testing.plane import Plane, as_state, beginnings, ends
from dmotion_bench.testing.settings_class import built
from dmotion_bench.testing.trial import specified

STEPS: Final = 4  # that each task is planned and carried out
NEAR: Final = 1e-4  # relative: plans of fewer tasks may be rounded otherwise


def check_solver(kind: type[Solver], *, actions: int | ActionSpec = 4) -> None:
    """Check a class of solvers on three tasks of a made-up world, in which a disc is to go where the goal shows it.

    Args:
        kind: The class, as its entry point names it.
        actions: What can be done: so many discrete actions, or a specification, such as ``CONTINUOUS``.

    A solver that does not bring the disc nearer is no breach, but a warning.

    Raises:
        PlannerContractBroken: At the first breach.
    """
    solver = built(kind)
    trial = _Trial(solver, specified(actions))
    trial.check_repeated()
    trial.check_alone()
    trial.check_blocked()
    left = trial.carried_out()
    if left >= 1:
        warnings.warn(
            f"{kind.__qualname__}: after {STEPS} steps {left:.0%} of the distance to the goal is left in a world whose "
            "predictions are true; a planner with it may not reach any goal.",
            stacklevel=2,
        )


class ToGoal(Memoryless):
    """Squared distance of the disc from where it is to be [strides^2].

    Args:
        wanted: Where that is, for each task [px].
        world: Says what a state is.
    """

    def __init__(self, wanted: Float[np.ndarray, "b 4"], world: Plane) -> None:
        self._wanted = world.features((as_state(wanted),))

    def step(
        self, dynamics: Dynamics, state: State, task: Int[Tensor, " n"], action: Actions, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        """The distance of each state."""
        apart = (dynamics.features(state) - self._wanted[task])[:, :2]
        return StepCost.of(apart.square().sum(dim=1)), ()


class _Trial:
    """A solver at work on the tasks.

    Args:
        solver: The solver.
        spec: What can be done.
    """

    def __init__(self, solver: Solver, spec: ActionSpec) -> None:
        self._solver, self._spec, self._world = solver, spec, Plane(spec)
        self._tasks = range(len(beginnings()))

    def check_repeated(self) -> None:
        """The same context gives the same plan, at the first step and at one with a memory; and it stays as it is."""
        memory = None
        for step in range(2):
            first, second = (self._context(self._tasks, step=step, memory=memory) for _ in range(2))
            plan = self._plan(first, self._tasks)
            self._require_untouched(first, second)
            self._require_same(
                plan,
                self._plan(second, self._tasks),
                "planned otherwise when it was given the same context again; random numbers must be drawn from "
                "context.generators, and nothing kept in the solver",
            )
            memory = plan.memory

    def check_alone(self) -> None:
        """Each task is planned as if it were alone, at the first step and at one with a memory."""
        memory = None
        for step in range(2):
            together = self._plan(self._context(self._tasks, step=step, memory=memory), self._tasks)
            for task in self._tasks:
                own = None if memory is None else memory[task : task + 1]
                alone = self._plan(self._context([task], step=step, memory=own), [task])
                self._require_same(
                    _of_task(together, task),
                    alone,
                    f"planned task {task} otherwise when it was alone; each task must draw from its own generator of "
                    "context.generators, and depend on no other",
                )
            memory = together.memory

    def check_blocked(self) -> None:
        """No action that is blocked comes first."""
        if not isinstance(self._spec, Discrete) or len(self._spec) < 2:
            return
        best = self._plan(self._context(self._tasks), self._tasks).action
        context = self._context(self._tasks)
        context.blocked[np.arange(len(best)), best] = True
        chosen = self._plan(context, self._tasks).action
        kept = [task for task in self._tasks if chosen[task] == best[task]]
        require(
            self._solver,
            "plan",
            not kept,
            f"chose for task {kept[0] if kept else ''} an action that context.blocked marks; such an action has "
            "changed nothing in the image before, and must not come first",
        )

    def carried_out(self) -> float:
        """Plan and act a few times: the share of the distance to the goals that is left."""
        places, memory = beginnings(), None
        for step in range(STEPS):
            plan = self._plan(self._context(self._tasks, places=places, step=step, memory=memory), self._tasks)
            places = self._world.moved(places, plan.action)
            memory = plan.memory
        apart, before = (np.abs(one - ends())[:, :2].sum() for one in (places, beginnings()))
        return float(apart / before)

    def _plan(self, context: PlanContext, tasks: Any) -> Plan:
        return checked_plan(self._solver, self._world, ToGoal(ends()[list(tasks)], self._world), context)

    def _context(
        self, tasks: Any, *, places: Float[np.ndarray, "n 4"] | None = None, step: int = 0, memory: Any = None
    ) -> PlanContext:
        """What the solver is given; made anew each time, equal for equal arguments."""
        chosen, count = list(tasks), len(self._spec) if isinstance(self._spec, Discrete) else 0
        now = (beginnings() if places is None else places)[chosen]
        seen: Observation = self._world.observed(now, ends()[chosen], step)
        return PlanContext(
            observation=seen,
            generators=tuple(np.random.default_rng((step, task)) for task in chosen),
            blocked=np.zeros((len(chosen), count), np.bool_),
            memory=None if memory is None else memory.copy(),
            experience=Experience(seen.current.copy(), count),
        )

    def _require_untouched(self, given: PlanContext, fresh: PlanContext) -> None:
        for name in ("previous", "current", "goals"):
            same = np.array_equal(getattr(given.observation, name), getattr(fresh.observation, name))
            self._require(same, f"wrote into context.observation.{name}; take a copy")
        self._require(np.array_equal(given.blocked, fresh.blocked), "wrote into context.blocked; take a copy")
        if given.memory is not None and fresh.memory is not None:
            self._require(np.array_equal(given.memory, fresh.memory), "wrote into context.memory; take a copy")

    def _require_same(self, one: Plan, other: Plan, sentence: str) -> None:
        for name in ("action", "candidates", "costs", "memory"):
            left, right = (getattr(plan, name) for plan in (one, other))
            self._require(_same(left, right), f"{sentence} ({name} of the plan)")

    def _require(self, holds: bool, sentence: str) -> None:
        require(self._solver, "plan", holds, sentence)


def _of_task(plan: Plan, task: int) -> Plan:
    """The part of a plan that is one task's."""
    own = slice(task, task + 1)
    return Plan(
        action=plan.action[own],
        candidates=plan.candidates[own],
        costs=plan.costs[own],
        progress=plan.progress[own],
        frames=plan.frames,
        memory=None if plan.memory is None else plan.memory[own],
    )


def _same(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is other
    left, right = np.asarray(one), np.asarray(other)
    return left.shape == right.shape and np.allclose(left, right, rtol=NEAR, atol=NEAR, equal_nan=True)
