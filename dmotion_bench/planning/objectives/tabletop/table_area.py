"""The part of the image where objects can stand: the table, found as the area with the ground's colour."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings


class TableArea:
    """The table under the objects of some tasks, as a polygon.

    Args:
        settings: See there.
        occlusion: Knows the ground's colour.
        frames: The present images.
        goals: What they should look like; they show some of the ground that the agent hides now.
    """

    def __init__(
        self,
        settings: TabletopSettings,
        occlusion: OcclusionModel,
        frames: UInt8[Tensor, "b h w 3"],
        goals: UInt8[Tensor, "b h w 3"],
    ) -> None:
        color, self._size = occlusion.color[:, None, None, None], frames.shape[1:3]
        of_ground = occlusion.alike(frames.float(), color) | occlusion.alike(goals.float(), color)
        patch = settings.table_patch_px
        bare = F.avg_pool2d(of_ground.float()[:, None], patch, stride=1, padding=patch // 2)[:, 0] > 0.5
        self._sides = _sides(bare, settings.table_sides)

    def depth(self, places: Float[Tensor, "n p 2"], task: Int[Tensor, " n"]) -> Float[Tensor, "n p"]:
        """How far places are from the edge [px], negative outside; infinite where there is no ground to see."""
        reach = places @ _outwards(places, self._sides.shape[1]).T
        return (self._sides[task, None] - reach).amin(dim=2).nan_to_num(torch.inf)

    @property
    def inside(self) -> Bool[Tensor, "b h w"]:
        """Which pixels lie on the table, without its outermost pixels."""
        down, across = (torch.arange(size, device=self._sides.device, dtype=torch.float32) for size in self._size)
        places = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1).flatten(0, 1)
        tasks = torch.arange(len(self._sides), device=self._sides.device)
        return (self.depth(places.expand(len(tasks), -1, -1), tasks) > 1).reshape(-1, *self._size)


def _sides(bare: Bool[Tensor, "b h w"], count: int) -> Float[Tensor, "b s"]:
    """The polygon around all visible ground, as the distances of its sides from the image's corner [px].

    Each side lies across its own direction; without any ground they are infinitely far away.
    """
    down, across = (torch.arange(size, device=bare.device, dtype=torch.float32) for size in bare.shape[1:])
    outwards = _outwards(down, count)
    some = bare.any(dim=2)
    sides: Float[Tensor, "b s"] = down.new_full((len(bare), count), -torch.inf)
    for end in _ends(bare):  # of each row: what lies between its ends is not at the edge
        reach = across[end][..., None] * outwards[:, 0] + down[:, None] * outwards[:, 1]
        sides = torch.maximum(sides, reach.where(some[..., None], reach.new_tensor(-torch.inf)).amax(dim=1))
    return sides.where(some.any(dim=1)[:, None], sides.new_tensor(torch.inf))


def _outwards(like: Tensor, count: int) -> Float[Tensor, "s 2"]:
    """The directions of the polygon's sides."""
    angle = torch.arange(count, device=like.device, dtype=like.dtype) * (2 * math.pi / count)
    return torch.stack([angle.cos(), angle.sin()], dim=1)


def _ends(bare: Bool[Tensor, "b h w"]) -> tuple[Int[Tensor, "b h"], Int[Tensor, "b h"]]:
    """The first and the last column of each row; any for rows that have none."""
    whole = bare.to(torch.uint8)
    return whole.argmax(dim=2), bare.shape[2] - 1 - whole.flip(2).argmax(dim=2)
