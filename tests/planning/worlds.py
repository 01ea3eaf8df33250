"""Small worlds that planners can be checked in: every future is known, and so is the best."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.planning.agents import ModelAgent
from dmotion_bench.planning.dynamics.base import Dynamics, Observation
from dmotion_bench.planning.objectives.base import CostState, Memoryless, StepCost
from dmotion_bench.planning.objectives.tracked import Tracked
from dmotion_bench.planning.solvers.base import Plan, PlanContext, Solver
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import Supervision
from recorders.grid_drawing import Version
from recorders.grid_rules import CELLS, advance
from recorders.grid_things import FACTS, draw

MOVES = torch.tensor([(0, -1), (0, 1), (-1, 0), (1, 0)])


class Walks:
    """A walker on an endless lattice; what a step costs depends on the task, the place and the way there.

    It is the dynamics, and ``PathCost`` the objective. The costs are arbitrary numbers out of a fixed function, so that
    hardly two sequences cost the same.
    """

    actions, at_once, device = Discrete.numbered(4), 7, torch.device("cpu")

    def __init__(self, tasks: tuple[int, ...]) -> None:
        self.tasks, self.names = len(tasks), torch.tensor(tasks)
        self.expanded: list[tuple[Any, ...]] = []
        self.evaluator: Memoryless = PathCost(self)

    @contextlib.contextmanager
    def computing(self, *, gradients: bool = False) -> Iterator[None]:
        with torch.inference_mode():
            yield

    def start(self, observation: Observation) -> tuple[Tensor, ...]:
        assert len(observation.current) == self.tasks
        nothing = torch.zeros(self.tasks, dtype=torch.long)
        return torch.zeros(self.tasks, 2, dtype=torch.long), nothing, torch.arange(self.tasks)

    def step(self, state: tuple[Tensor, ...], action: Int[Tensor, " n"]) -> tuple[Tensor, ...]:
        place, history, task = state
        place, history = place + MOVES[action], history * 5 + action + 1
        self.expanded += zip(task.tolist(), history.tolist(), strict=True)
        return place, history, task

    def frames(self, state: tuple[Tensor, ...]) -> Tensor:
        raise NotImplementedError

    def features(self, state: tuple[Tensor, ...]) -> Tensor:
        raise NotImplementedError

    def plan(self, solver: Solver, context: PlanContext) -> Plan:
        """The plan of a solver with this dynamics and its objective."""
        return solver.plan(self, self.evaluator, context)


class PathCost(Memoryless):
    """What a walk costs, by the way."""

    def __init__(self, walks: Walks) -> None:
        self.walks = walks

    def of(self, place: Tensor, history: Tensor, name: Tensor) -> Tensor:
        mixed = (place @ torch.tensor([73, 151]) + history * 31 + name * 57) * 2654435761 % 100003
        return 1.0 + mixed.double() / 100003

    def step(
        self, dynamics: Dynamics, state: tuple[Tensor, ...], task: Tensor, action: Tensor, cost_state: CostState
    ) -> tuple[StepCost, CostState]:
        place, history, own = state
        assert torch.equal(own, task)
        return StepCost.of(self.of(place, history, self.walks.names[task])), ()


class SmoothCost(PathCost):
    """The distance to a place of each task's own, so that CEM has something to follow."""

    def of(self, place: Tensor, history: Tensor, name: Tensor) -> Tensor:
        return (place - torch.stack([name % 4, -(name % 3)], dim=1)).square().sum(1).double()


class FarCost(PathCost):
    """Each task's goal lies so far in a corner that hardly a random walk comes near it."""

    def of(self, place: Tensor, history: Tensor, name: Tensor) -> Tensor:
        corner = torch.stack([1 - 2 * (name % 2), 1 - name // 2 % 2 * 2], dim=1)
        return (place - 4 * corner).abs().sum(1).double()


class SmoothWalks(Walks):
    """The same lattice with ``SmoothCost``."""

    def __init__(self, tasks: tuple[int, ...]) -> None:
        super().__init__(tasks)
        self.evaluator = SmoothCost(self)


class FarWalks(Walks):
    """The same lattice with ``FarCost``."""

    def __init__(self, tasks: tuple[int, ...]) -> None:
        super().__init__(tasks)
        self.evaluator = FarCost(self)


def observed(current: Any, previous: Any = None, goals: Any = None) -> Observation:
    """Images as they are given to a dynamics."""
    current = np.asarray(current)
    return Observation(
        previous=current if previous is None else np.asarray(previous),
        current=current,
        goals=current if goals is None else np.asarray(goals),
    )


def unseen(tasks: int) -> Observation:
    """Tasks of which nothing is seen."""
    return observed(np.zeros((tasks, 1, 1, 3), np.uint8))


def context(
    tasks: int, *, seed: int = 0, blocked: Any = None, memory: Any = None, observation: Observation | None = None
) -> PlanContext:
    """The beginning, with a generator for each task."""
    return PlanContext(
        observation=observation or unseen(tasks),
        generators=tuple(np.random.default_rng([seed, task]) for task in range(tasks)),
        blocked=np.zeros((tasks, 4), np.bool_) if blocked is None else blocked,
        memory=memory,
    )


class PerfectGridModel(ForwardModel[None]):
    """Knows the rules of Grid World and sees it through images alone: reads the cells off the frame and draws the next.

    It is not learned and has no weights.
    """

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "none"
    Config: ClassVar[type] = type(None)

    def __init__(self, version: Version = 1) -> None:
        super().__init__(None, ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
        self._version = version
        self._finder = PositionFinder(FACTS)
        self.frames = 0

    def losses(self, batch: TripletBatch) -> Losses:
        raise NotImplementedError

    def predict(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"], action: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        self.frames += len(action)
        found = self._finder.find(to_pixels(current))
        order = [len(FACTS.objects), *range(len(FACTS.objects))]  # the agent first
        there = found.found[:, order].numpy()
        cells = np.nan_to_num(found.centre[:, order].numpy() * CELLS / 128, nan=-9).astype(np.int64)
        after, there = advance(cells, there, action.numpy())
        stays = ~((after[:, 0] >= 0) & (after[:, 0] < CELLS)).all(-1)
        after[stays], there[:, 0] = cells[stays], True
        return to_model(torch.from_numpy(draw(after, there, self._version).frames))


def tracking(solver: CrossEntropy) -> ModelAgent:
    """The agent that knows the rules of Grid World."""
    return ModelAgent(PerfectGridModel(), FACTS, solver, Tracked(), bf16=False)
