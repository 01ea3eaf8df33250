"""Whether an objective keeps the contract of ``planning/objectives/base.py``."""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.contract import require
from dmotion_bench.planning.dynamics.base import Actions, State
from dmotion_bench.planning.objectives.base import CostState, Objective, StepCost, taught
from dmotion_bench.planning.objectives.checked import CheckedEvaluator, checked_reset
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.testing.plane import Plane, as_state, beginnings, drawn, ends
from dmotion_bench.testing.settings_class import built
from dmotion_bench.testing.trial import same, specified

CANDIDATES: Final = 3  # actions that are tried at each task
HORIZON: Final = 2
NEAR: Final = 1e-4  # relative: costs of the same state may be rounded otherwise in another batch


def check_objective(
    kind: type[Objective], *, actions: int | ActionSpec = 4, video: ReadableDataset | None = None
) -> None:
    """Check a class of objectives on three tasks of a made-up world, in which a disc shoves another one.

    Args:
        kind: The class, as its entry point names it.
        actions: What can be done: so many discrete actions, or a specification, such as ``CONTINUOUS``.
        video: What an objective with a method ``learned`` learns from; without, it is checked as it is before that.

    An objective to which the goal costs as much as the start is no breach, but a warning.

    Raises:
        PlannerContractBroken: At the first breach.
        InvalidSetting: It needs something that the made-up world lacks.
    """
    objective: Objective = built(kind)
    trial = _Trial(objective if video is None else taught(objective, video), specified(actions))
    trial.check_pure()
    trial.check_rows()
    trial.check_alone()
    if not trial.tells_goals():
        warnings.warn(
            f"{kind.__qualname__}: a state at the goal costs no less than one at the start, in each of "
            f"{len(beginnings())} tasks; no solver can reach a goal by such costs.",
            stacklevel=2,
        )


class _Remembering(Plane):
    """The world, which remembers what it has shown."""

    def __init__(self, actions: ActionSpec) -> None:
        super().__init__(actions)
        self._showed: list[tuple[Tensor, Tensor]] = []

    def frames(self, state: State) -> Float[Tensor, "n c h w"]:
        """See ``Plane``."""
        return self._shows(super().frames(state))

    def features(self, state: State) -> Float[Tensor, "n d"]:
        """See ``Plane``."""
        return self._shows(super().features(state))

    def shows_what_it_showed(self) -> bool:
        """Whether nobody has written into what it showed since it was asked last."""
        showed, self._showed = self._showed, []
        return all(same(kept, given) for kept, given in showed)

    def _shows(self, shown: Tensor) -> Tensor:
        self._showed.append((shown.detach().clone(), shown))
        return shown


class _Trial:
    """An objective at work on the tasks: in each some actions are tried twice in a row, after one real step.

    Args:
        objective: The objective.
        spec: What can be done.
    """

    def __init__(self, objective: Objective, spec: ActionSpec) -> None:
        self._objective, self._spec, self._world = objective, spec, _Remembering(spec)
        self._every = list(range(len(beginnings())))

    def check_pure(self) -> None:
        """Predicted steps may be asked for in any order and again, and what is shown stays as it is."""
        evaluator = self._begun(self._every)
        first = self._costs(evaluator, self._every)
        again = self._costs(evaluator, self._every, times=2)
        self._require_alike(
            evaluator,
            first,
            again,
            "found other costs when it was asked for the same states again; what predictions need is carried in "
            "cost_state, and only observe may keep something",
        )
        finite = bool(first.isfinite().all())
        self._require(evaluator, "step", finite, "found a cost that is no finite number, for discs in plain sight")

    def check_rows(self) -> None:
        """The cost of a state does not depend on its place in the batch."""
        evaluator = self._begun(self._every)
        usual = self._costs(evaluator, self._every)
        turned = self._costs(evaluator, self._every, reverse=True)
        self._require_alike(
            evaluator,
            usual,
            turned,
            "found other costs for the same states in another order; row i of a state is of the task task[i]",
        )

    def check_alone(self) -> None:
        """Each task costs what it would if it were alone."""
        evaluator = self._begun(self._every)
        together = self._costs(evaluator, self._every)
        for task in self._every:
            lone = self._begun([task])
            self._require_alike(
                lone,
                together[task : task + 1],
                self._costs(lone, [task]),
                f"found other costs for task {task} when it was alone; tasks must not depend on each other",
            )

    def tells_goals(self) -> bool:
        """Whether in some task a state at the goal costs less than one at the start."""
        evaluator, task = self._begun(self._every), torch.tensor(self._every)
        with self._world.computing():
            start, end = (
                evaluator.step(self._world, (as_state(places),), task, self._tried(task), evaluator.begin(self._world))
                for places in (beginnings(), ends())
            )
        return bool((end[0].total < start[0].total).any())

    def _begun(self, tasks: list[int]) -> CheckedEvaluator:
        """The tasks' evaluator after one real step and a second one in which nothing was done."""
        places, goals = beginnings()[tasks], ends()[tasks]
        start = self._world.observed(places, goals)
        kept = start.current.copy(), start.goals.copy()
        evaluator = checked_reset(self._objective, self._world.spec, start.current, start.goals)
        untouched = all(map(np.array_equal, (start.current, start.goals), kept))
        require(self._objective, "reset", untouched, "wrote into the images that it was given; take copies")
        taken = self._tried(torch.tensor(tasks)).numpy()
        after = self._world.moved(places, taken)
        nothing: Any = np.full(len(tasks), -1) if isinstance(self._spec, Discrete) else np.full_like(taken, np.nan)
        for actions in (taken, nothing):
            frames = drawn(after)
            seen = self._world.observed(after, goals).current
            done = actions.copy()
            evaluator.observe(actions, frames)
            untouched = np.array_equal(frames, seen)
            self._require(evaluator, "observe", untouched, "wrote into the images that it was given; take copies")
            untouched = np.array_equal(actions, done, equal_nan=True)
            self._require(evaluator, "observe", untouched, "wrote into the actions that it was given; take copies")
        return evaluator

    def _costs(
        self, evaluator: CheckedEvaluator, tasks: list[int], *, reverse: bool = False, times: int = 1
    ) -> Float[Tensor, "b s t"]:
        """Of each task's sequences the cost of each step after the real one, asked for so many times in a row."""
        rows = torch.arange(len(tasks) * CANDIDATES)
        rows = rows.flip(0) if reverse else rows
        task, which = rows // CANDIDATES, torch.tensor(tasks)
        places = self._world.moved(beginnings()[tasks], self._tried(which).numpy())
        costs = []
        with self._world.computing():
            carried = tuple(part[task] for part in self._carried(evaluator, len(tasks)))
            state: State = (as_state(places)[task],)
            for step in range(HORIZON):
                action = self._tried(which[task], rows % CANDIDATES + step)
                state = self._world.step(state, action)
                cost, carried = [self._step(evaluator, state, task, action, carried) for _ in range(times)][-1]
                costs.append(cost.total.detach())
        found = torch.empty(len(rows), HORIZON)
        found[rows] = torch.stack(costs, dim=1).float()
        return found.reshape(len(tasks), CANDIDATES, HORIZON)

    def _carried(self, evaluator: CheckedEvaluator, tasks: int) -> CostState:
        carried = evaluator.begin(self._world)
        self._require_rows(evaluator, "begin", carried, tasks)
        return carried

    def _step(
        self, evaluator: CheckedEvaluator, state: State, task: Int[Tensor, " n"], action: Actions, carried: CostState
    ) -> tuple[StepCost, CostState]:
        given = (*state, *carried, task, action)
        kept = [part.clone() for part in given]
        cost, after = evaluator.step(self._world, state, task, action, carried)
        untouched = all(map(same, kept, given))
        self._require(
            evaluator, "step", untouched, "wrote into the states, tasks, actions or cost_state given to it; take copies"
        )
        self._require(
            evaluator,
            "step",
            self._world.shows_what_it_showed(),
            "wrote into what dynamics.frames or dynamics.features gave it, which may be the model's state; take copies",
        )
        self._require_rows(evaluator, "step", after, len(task))
        return cost, after

    def _require_rows(self, evaluator: CheckedEvaluator, method: str, carried: CostState, count: int) -> None:
        wrong = [tuple(part.shape) for part in carried if part.shape[:1] != (count,)]
        told = f"carries on a tensor of the shape {wrong[:1]}; its first axis must be that of the {count} states"
        self._require(evaluator, method, not wrong, told)

    def _require_alike(self, evaluator: CheckedEvaluator, one: Tensor, other: Tensor, sentence: str) -> None:
        self._require(evaluator, "step", torch.allclose(one, other, rtol=NEAR, atol=NEAR, equal_nan=True), sentence)

    def _require(self, evaluator: CheckedEvaluator, method: str, holds: bool, sentence: str) -> None:
        require(evaluator.checked, method, holds, sentence)

    def _tried(self, task: Int[Tensor, " n"], shift: Int[Tensor, " n"] | int = 0) -> Actions:
        """An action for each row: discrete ones in turn, or continuous ones spread over [-1, 1]."""
        place = task * CANDIDATES + shift
        if isinstance(self._spec, Discrete):
            return place % len(self._spec)
        return torch.stack([((place + 1) * (part + 2) % 5 - 2) / 2 for part in range(self._spec.width)], dim=1)
