"""The part of the image where objects can stand: the table, found as the area with the ground's colour."""

from __future__ import annotations

import math
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.covering import Ground, alike

SIDES: Final = 64
"""The ground is taken for a polygon of so many sides around all that is seen of it, each of its own direction."""

PATCH: Final = 5
"""Ground is where most pixels of a square of so many a side have its colour; some of the agent's edges have it, too."""


class Table:
    """The table under the objects of some tasks, as a polygon.

    Args:
        ground: Knows its colour.
        frames: The present pictures.
        goals: What they should look like; they show some of the ground that the agent hides now.
    """

    def __init__(self, ground: Ground, frames: UInt8[Tensor, "b h w 3"], goals: UInt8[Tensor, "b h w 3"]) -> None:
        color, self._size = ground.color[:, None, None, None], frames.shape[1:3]
        of_ground = alike(frames.float(), color) | alike(goals.float(), color)
        bare = F.avg_pool2d(of_ground.float()[:, None], PATCH, stride=1, padding=PATCH // 2)[:, 0] > 0.5
        self._sides = _sides(bare)

    def depth(self, places: Float[Tensor, "n p 2"], task: Int[Tensor, " n"]) -> Float[Tensor, "n p"]:
        """How far places are from the edge [px], negative outside; infinite where there is no ground to see."""
        reach = places @ _outwards(places).T
        return (self._sides[task, None] - reach).amin(dim=2).nan_to_num(torch.inf)

    @property
    def inside(self) -> Bool[Tensor, "b h w"]:
        """Which pixels lie on the table, without its outermost pixels."""
        down, across = (torch.arange(size, device=self._sides.device, dtype=torch.float32) for size in self._size)
        places = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1).flatten(0, 1)
        tasks = torch.arange(len(self._sides), device=self._sides.device)
        return (self.depth(places.expand(len(tasks), -1, -1), tasks) > 1).reshape(-1, *self._size)


def _sides(bare: Bool[Tensor, "b h w"]) -> Float[Tensor, "b s"]:
    """The polygon around all visible ground, as the distances of its sides from the image's corner [px].

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


def _outwards(like: Tensor) -> Float[Tensor, "s 2"]:
    """The directions of the polygon's sides."""
    angle = torch.arange(SIDES, device=like.device, dtype=like.dtype) * (2 * math.pi / SIDES)
    return torch.stack([angle.cos(), angle.sin()], dim=1)


def _ends(bare: Bool[Tensor, "b h w"]) -> tuple[Int[Tensor, "b h"], Int[Tensor, "b h"]]:
    """The first and the last column of each row; any for rows that have none."""
    whole = bare.to(torch.uint8)
    return whole.argmax(dim=2), bare.shape[2] - 1 - whole.flip(2).argmax(dim=2)
