"""Small worlds that planners can be checked in: every future is known, and so is the best."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.planning.planner import Moment
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import Supervision
from recorders.grid_drawing import CELLS, Version
from recorders.grid_world import FACTS, advance, draw

MOVES = torch.tensor([(0, -1), (0, 1), (-1, 0), (1, 0)])


class Walks:
    """A walker on an endless lattice; what a step costs depends on the task, the place and the way there.

    The costs are arbitrary numbers out of a fixed function, so that hardly two sequences cost the same.
    """

    actions, at_once = 4, 7

    def __init__(self, tasks: tuple[int, ...]) -> None:
        self.tasks, self._names = len(tasks), torch.tensor(tasks)
        self.expanded: list[tuple[Any, ...]] = []

    def begin(self) -> tuple[Tensor, ...]:
        return torch.zeros(self.tasks, 2, dtype=torch.long), torch.zeros(self.tasks, dtype=torch.long)

    def expand(
        self, states: tuple[Tensor, ...], task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[tuple[Tensor, ...], Float[Tensor, " n"]]:
        place, history = states
        place, history = place + MOVES[action], history * 5 + action + 1
        self.expanded += zip(task.tolist(), history.tolist(), strict=True)
        mixed = (place @ torch.tensor([73, 151]) + history * 31 + self._names[task] * 57) * 2654435761 % 100003
        return (place, history), 1.0 + mixed.double() / 100003


class SmoothWalks(Walks):
    """The same lattice; the cost is the distance to a place of each task's own, so that CEM has something to follow."""

    def expand(
        self, states: tuple[Tensor, ...], task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[tuple[Tensor, ...], Float[Tensor, " n"]]:
        after, _ = super().expand(states, task, action)
        goal = torch.stack([self._names[task] % 4, -(self._names[task] % 3)], dim=1)
        return after, (after[0] - goal).square().sum(1).double()


class FarWalks(Walks):
    """The same lattice; each task's goal lies so far in a corner that hardly a random walk comes near it."""

    def expand(
        self, states: tuple[Tensor, ...], task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[tuple[Tensor, ...], Float[Tensor, " n"]]:
        after, _ = super().expand(states, task, action)
        corner = torch.stack([1 - 2 * (self._names[task] % 2), 1 - self._names[task] // 2 % 2 * 2], dim=1)
        return after, (after[0] - 4 * corner).abs().sum(1).double()


def moment(tasks: int, *, seed: int = 0, blocked: Any = None) -> Moment:
    """The beginning, with a generator for each task."""
    return Moment(
        generators=tuple(np.random.default_rng([seed, task]) for task in range(tasks)),
        blocked=np.zeros((tasks, 4), np.bool_) if blocked is None else blocked,
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
