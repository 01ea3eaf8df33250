"""The risk that the next push makes an object fall off the table's edge.

An object that falls is lost for good, and models rarely see it coming: of a push over the edge they imagine a pixel,
a smear that looks as if something covered the object, or, if they carry pixels along, the object a little farther
out. But already the first imagined step, which is predicted from real pictures, leaves little of the object then, or
leaves less than all of it, and that farther out (measured in DECISIONS.md). How often such a step makes an object fall
is what it costs; unless something passes before the object. That shows below it: the camera looks down on the table, so
what is nearer to it stands lower in the picture, while whatever pushes the object away is no lower than the object
itself. Nothing but pictures is looked at.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.covering import Ground, alike
from dmotion_bench.planning.table import Table
from dmotion_bench.planning.tracking import Outlines, Tracker

MARGIN: Final = 11 / 128
"""An object whose centre is nearer to the edge than this share of the frame's width is watched."""

OPEN: Final = 0.3
"""Of its usual pixels so many are seen of it; of one that the agent hides already any step may hide the rest."""

GONE: Final = 0.15
"""Next to nothing is left of an object: less than this share of the pixels that are seen of it now."""

OUT: Final = 0.5 / 128
"""It is carried out if what is seen of it moves by more than this towards the edge, as a share of the frame's width."""

HALF: Final = 0.5
SURE: Final = 0.7
MOST: Final = 0.9
"""An object that is carried out is likely to fall if less than half of its pixels are left, and may fall if less than
most of them are; one that is not may fall if too few are left to be sure of it."""

LIKELY: Final = 2 / 3
UNLIKELY: Final = 1 / 16
"""The shares of such steps that make an object fall [measured; of the second kind it is 1/23 before anybody chooses
among them]."""

BELOW: Final = (3 / 128, 16 / 128)
"""What passes before an object shows so far below its outline, from and to, as shares of the frame's width."""

BESIDE: Final = 3 / 128
"""And at most so far to the left and the right of it."""

THIN: Final = 2
"""In some row there it has at least so many pixels."""


class Edges:
    """The objects of some tasks that stand near the table's edge.

    Args:
        tracker: Knows what is an object and no ground.
        ground: Knows the ground's colours, and what is seen of the objects.
        table: Whose edge it is.
        frames: The present pictures.
        known: Where the objects are in the present pictures.
    """

    def __init__(
        self,
        tracker: Tracker,
        ground: Ground,
        table: Table,
        frames: UInt8[Tensor, "b h w 3"],
        known: Outlines,
    ) -> None:
        self._tracker, self._known, self._width = tracker, known, frames.shape[2]
        self._color: Float[Tensor, "b 1 1 1 3"] = ground.color[:, None, None, None]
        self._strange = ~alike(frames.float(), self._color) & ~tracker.show_objects(frames)
        tasks = torch.arange(len(frames), device=frames.device)
        self._table, self._pixels, self._depth = table, ground.now.pixels, table.depth(ground.now.centre, tasks)
        near = table.depth(known.centre, tasks) < MARGIN * self._width
        self._watched: Bool[Tensor, "b k"] = near & (ground.now.pixels >= OPEN * known.pixels)

    def risk(
        self, frames: UInt8[Tensor, "n h w 3"], now: Outlines, task: Int[Tensor, " n"], asked: Bool[Tensor, "n k"]
    ) -> Float[Tensor, "n k"]:
        """The probability that the step to these images makes an object fall; zero for objects not asked about.

        Args:
            frames: The pictures.
            now: What is seen of the objects in them.
            task: Whose they are.
            asked: The objects.
        """
        left = now.pixels / self._pixels[task].clamp(min=1)
        out = self._depth[task] - self._table.depth(now.centre, task) > OUT * self._width
        likely = (left < GONE) | (out & (left < HALF))
        may = asked & self._watched[task] & (likely | (left < SURE) | (out & (left < MOST)))
        for place, one in may.nonzero().tolist():
            may[place, one] = not self._is_passed(frames[place], int(task[place]), one)
        return torch.where(likely, LIKELY, UNLIKELY) * may

    def _is_passed(self, picture: UInt8[Tensor, "h w 3"], task: int, one: int) -> bool:
        """Whether something new, neither ground nor object, is visible below an object."""
        centre, low, high = (part[task, one] for part in (self._known.centre, self._known.low, self._known.high))
        bottom, (near, far), beside = float(centre[1] + high[1]), BELOW, BESIDE * self._width
        rows = slice(math.ceil(bottom + near * self._width), math.ceil(bottom + far * self._width))
        left, right = math.floor(centre[0] - low[0] - beside), math.ceil(centre[0] + high[0] + beside)
        below = (rows, slice(max(left, 0), max(right, 0)))
        strip = picture[below][None]
        new = ~alike(strip.float(), self._color[task]) & ~self._tracker.show_objects(strip)
        return bool(((new[0] & ~self._strange[task][below]).sum(dim=1) >= THIN).any())
