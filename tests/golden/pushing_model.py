"""A model of the pushing worlds without training: the agent moves, and what its lower end touches goes along.

All that it computes is whole numbers, so it draws the same frames on every processor.
"""

from __future__ import annotations

from typing import ClassVar, Final

import torch
import torch.nn.functional as F
from torch import Tensor

from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.positions import PositionFinder
from dmotion_bench.specs import EnvSpec, Supervision

STEP: Final = 8  # [px]
MOVES: Final = ((-STEP, 0), (STEP, 0), (0, -STEP), (0, STEP))  # up, down, left, right; (rows, columns)
ALIKE: Final = 40  # of 255; what differs less from the agent's colour is the agent
TIP: Final = 10  # rows at the agent's lower end that push
REACH: Final = 2  # [px]; how near to an object the tip touches it


class PushingModel(ForwardModel[None]):
    """Moves the agent and what it touches; what they uncover is the table's colour."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "none"
    Config: ClassVar[type] = type(None)

    def __init__(self, spec: EnvSpec, table: tuple[int, int, int]) -> None:
        super().__init__(None, ModelInputs(height=spec.height, width=spec.width, actions=spec.actions))
        self._finder, self._count = PositionFinder(spec), len(spec.objects)
        self._agent, self._table = (torch.tensor(color, dtype=torch.int16) for color in (spec.agent.color, table))

    def losses(self, batch: TripletBatch) -> Losses:
        raise NotImplementedError

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        before = to_pixels(current)
        agent = ((before.to(torch.int16) - self._agent).abs() < ALIKE).all(dim=-1)
        labels = self._finder.labels(before)
        objects = torch.stack([labels == number for number in range(self._count)], dim=1) & ~agent[:, None]
        rows = torch.arange(agent.shape[1])
        lowest = torch.where(agent.any(dim=2), rows, -1).amax(dim=1)
        tip = agent & (rows > lowest[:, None] - TIP)[..., None]
        near = F.max_pool2d(moved(tip, action)[:, None].float(), 2 * REACH + 1, stride=1, padding=REACH) > 0
        pushed = (objects & near).any(dim=(2, 3), keepdim=True)
        moving = agent | (objects & pushed).any(dim=1)
        after = torch.where(moving[..., None], self._table.to(torch.uint8), before)
        after = torch.where(moved(moving, action)[..., None], moved(before, action), after)
        return to_model(after)


def moved(pictures: Tensor, action: Tensor) -> Tensor:
    """Pictures, or masks, moved by their own actions; zeros come in from outside."""
    result = torch.zeros_like(pictures)
    for number, (down, right) in enumerate(MOVES):
        own = action == number
        rolled = pictures[own].roll((down, right), dims=(1, 2))
        rolled[:, slice(0, down) if down >= 0 else slice(down, None)] = 0
        rolled[:, :, slice(0, right) if right >= 0 else slice(right, None)] = 0
        result[own] = rolled
    return result
