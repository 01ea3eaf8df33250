"""How near the agent is to a place from which it can push a misplaced object.

An object that has to go to the left is pushed from the right, and one that has to come nearer from behind. Whatever
the few actions that a planner looks ahead lead to, that place is nearer after some of them than after others, so it
gives a direction where no push is within reach. The way there goes around the object.

Where the agent is, images tell: the camera looks down on the table, so what neither is an object nor looks like the
ground is the agent, and it stands where that reaches lowest: the tip of its tool, in Robot Push found to a pixel
[measured].
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.planning.objectives.tabletop.table_area import TableArea
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker


class PushPoseBonus:
    """The places from which objects can be pushed towards their goals, along the image's axes; for several tasks.

    Args:
        settings: See there.
        tracker: Knows what is an object and no agent.
        occlusion: Knows the ground's colour.
        table: Where the tool's tip is looked for.
        known, wanted: Where the objects are, and where they should be.
        sought: The objects that are to be pushed.
    """

    def __init__(
        self,
        settings: TabletopSettings,
        tracker: Tracker,
        occlusion: OcclusionModel,
        table: TableArea,
        known: BoundingBoxes,
        wanted: BoundingBoxes,
        sought: Bool[Tensor, "b k"],
    ) -> None:
        self._settings, self._tracker, inside = settings, tracker, table.inside
        rows = inside.any(dim=2).any(dim=0).nonzero()[:, 0]
        self._top, self._end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        self._inside, self._width = inside[:, self._top : self._end], inside.shape[2]
        color, reach = occlusion.color.nan_to_num(0.0).to(torch.int16), math.ceil(settings.ground_tolerance) - 1
        dark, bright = (color - reach).clamp(min=0), (color + reach).clamp(max=255)
        self._dark, self._spread = dark.to(torch.uint8), (bright - dark).to(torch.uint8)
        off = (wanted.centre - known.centre).nan_to_num(0.0)
        half, clearance, far = (known.low + known.high) / 2, settings.clearance * self._width, off.abs()
        self._along, self._aside = half + clearance, half.flip(-1) + clearance
        self._centre, self._sign = known.centre, off.sign()
        long_enough = far >= settings.push_axis_share * far.amax(dim=-1, keepdim=True)
        use = sought[..., None] & (far > 0) & long_enough
        handicap = far.where(use, torch.zeros_like(far))
        handicap = handicap.amax(dim=(1, 2), keepdim=True) - handicap
        self._handicap = handicap.where(use, torch.full_like(far, torch.inf))

    def nearness(self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """How near the agent is to such a place: 1 at that of the object farthest from its goal, 0 a frame's width off.

        The others count as that much farther away as their own ways are shorter. 0 where no agent is seen.
        """
        apart = self.tool_tip(frames, task)[:, None] - self._centre[task]
        along, across = apart * self._sign[task], apart.flip(-1).abs()  # of the two axes
        back, aside = self._along[task], self._aside[task]
        straight = torch.hypot(along + back, across)
        around = torch.hypot(along, across - aside) + torch.hypot(back, aside)
        clear = (along <= -back * 0.7) | ((along <= 0) & (across >= aside))
        way = (torch.where(clear, straight, around) + self._handicap[task]).nan_to_num(torch.inf).amin(dim=(1, 2))
        nearness: Tensor = (1 - way / self._width).clamp(min=0)
        return nearness

    def tool_tip(self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"]) -> Float[Tensor, "n 2"]:
        """Where the agent stands, (x, y) [px]; NaN where none is seen."""
        frames = frames[:, self._top : self._end]
        agent = self._inside[task] & ~self._tracker.show_objects(frames)
        if self._settings.ground_tolerance > 0:
            dark, spread = self._dark[task, :, None, None], self._spread[task, :, None, None]
            ground = frames[..., 0] - dark[:, 0] <= spread[:, 0]  # 8 bits go round at 256: darker ones become bright
            for one in range(1, frames.shape[-1]):
                ground &= frames[..., one] - dark[:, one] <= spread[:, one]
            agent &= ~ground
        solid = agent[:, :, 1:-1] & agent[:, :, :-2] & agent[:, :, 2:]  # no blurred edges
        solid = solid[:, 1:-1] & solid[:, :-2] & solid[:, 2:]
        some = solid.any(dim=2)
        lowest = some.shape[1] - 1 - some.flip(1).to(torch.uint8).argmax(dim=1)
        tip = (lowest[:, None] - torch.arange(self._settings.tip_rows, device=lowest.device)).clamp(min=0)
        count = solid[torch.arange(len(solid), device=lowest.device)[:, None], tip].sum(dim=1)
        x = (count * torch.arange(solid.shape[2], device=lowest.device)).sum(dim=1) / count.sum(dim=1)
        return torch.stack([x + 1, torch.where(some.any(dim=1), lowest + self._top + 1.0, torch.nan)], dim=1)
