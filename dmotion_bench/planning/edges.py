"""Which objects stand at the table's edge, where a push that a model imagines as nothing much may be the last one.

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
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.covering import Ground, alike
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
"""The shares of such steps that make an object fall [measured; of the second kind it is 1/25 before anybody chooses
among them]."""

BELOW: Final = (3 / 128, 16 / 128)
"""What passes before an object shows so far below its outline, from and to, as shares of the frame's width."""

BESIDE: Final = 3 / 128
"""And at most so far to the left and the right of it."""

THIN: Final = 2
"""In some row there it has at least so many pixels."""

SIDES: Final = 64
"""The ground is taken for a polygon of so many sides around all that is seen of it, each of its own direction."""

PATCH: Final = 5
"""Ground is where most pixels of a square of so many a side have its colour; some of the agent's edges have it, too."""


class Edges:
    """The objects of some tasks that are near the edge of what they stand on.

    Args:
        tracker: Knows what is an object and no ground.
        ground: Knows the ground's colours.
        frames: The present pictures.
        goals: What they should look like; they show some of the ground that the agent hides now.
        known: Where the objects are in the present pictures.
    """

    def __init__(
        self,
        tracker: Tracker,
        ground: Ground,
        frames: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
        known: Outlines,
    ) -> None:
        self._tracker, self._known, self._width = tracker, known, frames.shape[2]
        self._color: Float[Tensor, "b 1 1 1 3"] = ground.color[:, None, None, None]
        now, then = (alike(pictures.float(), self._color) for pictures in (frames, goals))
        bare = F.avg_pool2d((now | then).float()[:, None], PATCH, stride=1, padding=PATCH // 2)[:, 0] > 0.5
        self._strange = ~now & ~tracker.show_objects(frames)
        self._sides, seen = _sides(bare), tracker.look(frames)
        self._pixels, self._depth = seen.pixels, _depth(self._sides, seen.centre)
        near = _depth(self._sides, known.centre) < MARGIN * self._width
        self._watched: Bool[Tensor, "b k"] = near & (seen.pixels >= OPEN * known.pixels)

    def risk(
        self, frames: UInt8[Tensor, "n h w 3"], now: Outlines, task: Int[Tensor, " n"], asked: Bool[Tensor, "n k"]
    ) -> Float[Tensor, "n k"]:
        """The chance that the step that leads to the pictures makes an object fall, zero for those not asked about.

        Args:
            frames: The pictures.
            now: What is seen of the objects in them.
            task: Whose they are.
            asked: The objects.
        """
        left = now.pixels / self._pixels[task].clamp(min=1)
        out = self._depth[task] - _depth(self._sides[task], now.centre) > OUT * self._width
        likely = (left < GONE) | (out & (left < HALF))
        may = asked & self._watched[task] & (likely | (left < SURE) | (out & (left < MOST)))
        for place, one in may.nonzero().tolist():
            may[place, one] = not self._is_passed(frames[place], int(task[place]), one)
        return torch.where(likely, LIKELY, UNLIKELY) * may

    def _is_passed(self, picture: UInt8[Tensor, "h w 3"], task: int, one: int) -> bool:
        """Whether something new is to be seen below an object: neither ground nor object, and not there before."""
        centre, low, high = (part[task, one] for part in (self._known.centre, self._known.low, self._known.high))
        bottom, (near, far), beside = float(centre[1] + high[1]), BELOW, BESIDE * self._width
        rows = slice(math.ceil(bottom + near * self._width), math.ceil(bottom + far * self._width))
        left, right = math.floor(centre[0] - low[0] - beside), math.ceil(centre[0] + high[0] + beside)
        below = (rows, slice(max(left, 0), max(right, 0)))
        strip = picture[below][None]
        new = ~alike(strip.float(), self._color[task]) & ~self._tracker.show_objects(strip)
        return bool(((new[0] & ~self._strange[task][below]).sum(dim=1) >= THIN).any())


def _sides(bare: Bool[Tensor, "b h w"]) -> Float[Tensor, "b s"]:
    """The polygon around all that is seen of the ground: how far its sides are from the picture's corner [px].

    Each side lies across its own direction; without any ground they are infinitely far away.
    """
    down, across = (torch.arange(size, device=bare.device, dtype=torch.float32) for size in bare.shape[1:])
    outwards = _outwards(down)
    some = bare.any(dim=2)
    sides: Float[Tensor, "b s"] = down.new_full((len(bare), SIDES), -torch.inf)
    for end in _ends(bare):  # of each row: what lies between its ends is not at the edge
        reach = across[end][..., None] * outwards[:, 0] + down[:, None] * outwards[:, 1]
        sides = torch.maximum(sides, reach.where(some[..., None], reach.new_tensor(-torch.inf)).amax(dim=1))
    return sides.where(some.any(dim=1)[:, None], sides.new_tensor(torch.inf))


def _depth(sides: Float[Tensor, "b s"], centre: Float[Tensor, "b k 2"]) -> Float[Tensor, "b k"]:
    """How far objects are from the edge of the ground [px], negative outside; infinite where there is none to see."""
    return (sides[:, None] - centre @ _outwards(centre).T).amin(dim=2).nan_to_num(torch.inf)


def _outwards(like: Tensor) -> Float[Tensor, "s 2"]:
    """The directions of the polygon's sides."""
    angle = torch.arange(SIDES, device=like.device, dtype=like.dtype) * (2 * math.pi / SIDES)
    return torch.stack([angle.cos(), angle.sin()], dim=1)


def _ends(bare: Bool[Tensor, "b h w"]) -> tuple[Int[Tensor, "b h"], Int[Tensor, "b h"]]:
    """The first and the last column of each row; any for rows that have none."""
    whole = bare.to(torch.uint8)
    return whole.argmax(dim=2), bare.shape[2] - 1 - whole.flip(2).argmax(dim=2)
