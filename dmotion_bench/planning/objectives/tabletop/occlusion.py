"""Whether an object that is not visible in a real or predicted image is hidden or has fallen off the table.

What has fallen leaves bare ground where it was; what is hidden has the agent's pixels there, or some of them already.
What the ground looks like is seen around the object in the present image. Only images are used.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker


class OcclusionModel:
    """The ground colours around each object of some tasks, and what they say about objects out of sight.

    Args:
        settings: See there.
        tracker: Knows what is an object and no ground.
        frames: The present images.
        known: Where the objects are in them.
    """

    def __init__(
        self, settings: TabletopSettings, tracker: Tracker, frames: UInt8[Tensor, "b h w 3"], known: BoundingBoxes
    ) -> None:
        near, far = settings.ground_from * frames.shape[2], settings.ground_to * frames.shape[2]
        self._settings, self._known, self._frames = settings, known, frames
        self.now = tracker.look(frames)
        """What the present images show by themselves."""
        self._colors: Float[Tensor, "b k 2 3"] = known.centre.new_full((*known.centre.shape[:2], 2, 3), torch.nan)
        self._hidden = self.now.pixels < settings.fully_seen * known.pixels
        objects = tracker.show_objects(frames)
        for task, one in (~known.centre[..., 0].isnan()).nonzero().tolist():
            ring = torch.zeros_like(frames[task, :, :, 0], dtype=torch.bool)
            ring[self._box(task, one, far, ring)] = True
            ring[self._box(task, one, near, ring)] = False
            around = frames[task][ring & ~objects[task]].float()
            enough = settings.second_ground_share * len(around)
            for place in range(2):
                if len(around) > place * enough:
                    self._colors[task, one, place] = around[around.sum(dim=1).argsort(stable=True)[len(around) // 2]]
                    around = around[~self.alike(around, self._colors[task, one])]

    def hides(
        self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"], asked: Bool[Tensor, "n k"]
    ) -> Bool[Tensor, "n k"]:
        """Which of the invisible objects in ``asked`` are hidden behind something, rather than fallen."""
        covered = asked & self._hidden[task]
        for place, one in (asked & ~covered).nonzero().tolist():
            own = int(task[place])
            covered[place, one] = self._is_covered(frames[place], own, one, self._colors[own, one])
        return covered

    @property
    def standing(self) -> Bool[Tensor, "b k"]:
        """Which objects are still on the table: visible in the present images, or hidden at their last known place."""
        standing, color = self.now.seen.clone(), self.color
        for task, one in (~standing & ~self._known.centre[..., 0].isnan()).nonzero().tolist():
            standing[task, one] = self._is_covered(self._frames[task], task, one, color[task, None])
        return standing

    @property
    def color(self) -> Float[Tensor, "b 3"]:
        """The ground colour that most objects of a task stand on; NaN if it is unknown."""
        colors = self._colors[:, :, 0]
        apart = (colors[:, :, None] - colors[:, None]).abs().amax(dim=-1)
        agree = (apart < self._settings.ground_tolerance).sum(dim=2)
        votes = agree * (1 + self.now.seen)  # what hides an object may be around it, too
        return colors[torch.arange(len(colors)), votes.argmax(dim=1)]

    def alike(self, pixels: Float[Tensor, "*p 3"], colors: Float[Tensor, "*c 3"]) -> Bool[Tensor, "*p"]:
        """Which pixels have one of some ground colours, the same for all or each its own; NaN is none."""
        apart = (pixels[..., None, :] - colors).abs().amax(dim=-1)
        found: Bool[Tensor, "*p"] = (apart < self._settings.ground_tolerance).any(dim=-1)
        return found

    def _is_covered(self, picture: UInt8[Tensor, "h w 3"], task: int, one: int, colors: Float[Tensor, "c 3"]) -> bool:
        """Whether an image shows anything but these ground colours at the object's last place."""
        bare = self.alike(picture[self._box(task, one, 0.0, picture)].float(), colors)
        return bare.numel() > 0 and float(bare.float().mean()) < self._settings.bare_share

    def _box(self, task: int, one: int, beyond: float, picture: Tensor) -> tuple[slice, slice]:
        """The part of an image within an object's bounding box, and so far beyond it."""
        centre, low, high = (part[task, one] for part in (self._known.centre, self._known.low, self._known.high))
        left, top = (centre - low - beyond).floor().int().tolist()
        right, bottom = (centre + high + beyond).ceil().int().tolist()
        height, width = picture.shape[:2]
        return slice(min(max(top, 0), height), max(bottom, 0)), slice(min(max(left, 0), width), max(right, 0))
