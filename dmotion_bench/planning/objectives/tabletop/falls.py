"""The risk that the next push makes an object fall off the table's edge.

An object that falls is lost for good, and models rarely see it coming: of a push over the edge they predict a pixel,
a smear that looks as if something hid the object, or, if they carry pixels along, the object a little farther out.
But already the first predicted step, which starts from real images, leaves little of the object then, or leaves less
than all of it, and that farther out (``docs/experiments/falls.md``). How often such a step makes an object fall is
its risk; unless something passes before the object. That shows below it: the camera looks down on the table, so what
is nearer to it stands lower in the image, while whatever pushes the object away is no lower than the object itself.
Only images are used.
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


class FallRisk:
    """The objects of some tasks that stand near the table's edge.

    Args:
        settings: See there.
        tracker: Knows what is an object and no ground.
        occlusion: Knows the ground's colours, and what is seen of the objects.
        table: Whose edge it is.
        frames: The present images.
        known: Where the objects are in them.
    """

    def __init__(
        self,
        settings: TabletopSettings,
        tracker: Tracker,
        occlusion: OcclusionModel,
        table: TableArea,
        frames: UInt8[Tensor, "b h w 3"],
        known: BoundingBoxes,
    ) -> None:
        self._settings, self._occlusion = settings, occlusion
        self._tracker, self._known, self._width = tracker, known, frames.shape[2]
        self._color: Float[Tensor, "b 1 1 1 3"] = occlusion.color[:, None, None, None]
        self._strange = ~occlusion.alike(frames.float(), self._color) & ~tracker.show_objects(frames)
        tasks = torch.arange(len(frames), device=frames.device)
        self._table, self._pixels = table, occlusion.now.pixels
        self._depth = table.depth(occlusion.now.centre, tasks)
        near = table.depth(known.centre, tasks) < settings.edge_margin * self._width
        self._watched: Bool[Tensor, "b k"] = near & (occlusion.now.pixels >= settings.edge_open_share * known.pixels)

    def risk(
        self, frames: UInt8[Tensor, "n h w 3"], now: BoundingBoxes, task: Int[Tensor, " n"], asked: Bool[Tensor, "n k"]
    ) -> Float[Tensor, "n k"]:
        """The probability that the step to these images makes an object fall; zero for objects not asked about.

        Args:
            frames: The images.
            now: What is seen of the objects in them.
            task: Whose they are.
            asked: The objects.
        """
        own = self._settings
        left = now.pixels / self._pixels[task].clamp(min=1)
        out = self._depth[task] - self._table.depth(now.centre, task) > own.outward_motion * self._width
        likely = (left < own.gone_share) | (out & (left < own.fall_below))
        may = asked & self._watched[task] & (likely | (left < own.unsure_below) | (out & (left < own.may_fall_below)))
        for place, one in may.nonzero().tolist():
            may[place, one] = not self._is_passed(frames[place], int(task[place]), one)
        return torch.where(likely, own.fall_likely, own.fall_unlikely) * may

    def _is_passed(self, picture: UInt8[Tensor, "h w 3"], task: int, one: int) -> bool:
        """Whether something new, neither ground nor object, is visible below an object."""
        centre, low, high = (part[task, one] for part in (self._known.centre, self._known.low, self._known.high))
        (near, far), beside = self._settings.passing_below, self._settings.passing_beside * self._width
        bottom = float(centre[1] + high[1])
        rows = slice(math.ceil(bottom + near * self._width), math.ceil(bottom + far * self._width))
        left, right = math.floor(centre[0] - low[0] - beside), math.ceil(centre[0] + high[0] + beside)
        below = (rows, slice(max(left, 0), max(right, 0)))
        strip = picture[below][None]
        new = ~self._occlusion.alike(strip.float(), self._color[task]) & ~self._tracker.show_objects(strip)
        count = (new[0] & ~self._strange[task][below]).sum(dim=1)
        return bool((count >= self._settings.passing_pixels).any())
