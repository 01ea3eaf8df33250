"""The places of objects as far as images tell, including objects that the agent hides.

The centre of an object's visible pixels moves when something passes in front of it, by up to half the object. A
planner that believes it finds the agent's place that hides the right half of an object better than any push, and
stays there. So an object that is not fully seen is believed to be where it was last seen, moved by no more than it
takes for what is visible of it to lie within its bounding box then. Only images are used.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.positions import PositionFinder, Positions
from dmotion_bench.specs import EnvSpec


@runtime_checkable
class TrackingSettings(Protocol):
    """What the tracker asks of an objective's settings.

    Attributes:
        fully_seen: The share of an object's usual pixels from which on it counts as fully seen.
        box_margin_px: A visible part may lie this far outside the bounding box [px]: predicted edges are not sharp.
    """

    @property
    def fully_seen(self) -> float: ...

    @property
    def box_margin_px(self) -> float: ...


@dataclass(frozen=True, kw_only=True)
class BoundingBoxes:
    """The bounding boxes of objects [px].

    Attributes:
        centre: (x, y).
        low, high: How far the boxes reach to the left and the top, to the right and the bottom, of the centre.
        pixels: How many an object has when nothing hides it.
        seen: Whether anything is seen of it now.
    """

    centre: Float[Tensor, "b k 2"]
    low: Float[Tensor, "b k 2"]
    high: Float[Tensor, "b k 2"]
    pixels: Int[Tensor, "b k"]
    seen: Bool[Tensor, "b k"]

    def to(self, device: torch.device) -> BoundingBoxes:
        """The same on a device."""
        return BoundingBoxes(**{one.name: getattr(self, one.name).to(device) for one in fields(self)})

    def of(self, rows: Int[Tensor, " n"]) -> BoundingBoxes:
        """The rows with these task numbers."""
        rows = rows.to(self.centre.device)
        return BoundingBoxes(**{one.name: getattr(self, one.name)[rows] for one in fields(self)})

    def where(self, chosen: Bool[Tensor, "b k"], other: BoundingBoxes) -> BoundingBoxes:
        """These values for the chosen objects, and those of ``other`` for the rest."""
        pairs = {one.name: (getattr(self, one.name), getattr(other, one.name)) for one in fields(self)}
        return BoundingBoxes(
            **{
                name: torch.where(chosen if mine.ndim == 2 else chosen[..., None], mine, theirs)
                for name, (mine, theirs) in pairs.items()
            }
        )


class Tracker:
    """Finds the objects in images, and remembers those that are hidden.

    Args:
        spec: Says what they look like; it must have some.
        settings: What counts as fully seen.
    """

    def __init__(self, spec: EnvSpec, settings: TrackingSettings) -> None:
        self._finder, self._objects, self._settings = _finder(spec), len(spec.objects), settings

    def look(self, frames: UInt8[Tensor, "b h w 3"]) -> BoundingBoxes:
        """The objects that each image shows, without any history; an object that is not found has the centre NaN."""
        found, extents = self._finder.find_extents(frames)
        return self._boxes(found, extents)

    def look_near(self, known: BoundingBoxes, frames: UInt8[Tensor, "b h w 3"], reach: float) -> BoundingBoxes:
        """The part of each object that images show within ``reach`` [px] of its last bounding box."""
        low, high = known.centre - known.low - reach, known.centre + known.high + reach
        return self._boxes(*self._finder.find_within(frames, low, high))

    def _boxes(self, found: Positions, extents: Float[Tensor, "b k 2 2"]) -> BoundingBoxes:
        centre, extent = found.centre[:, : self._objects], extents[:, : self._objects]
        return BoundingBoxes(
            centre=centre,
            low=centre - extent[..., 0],
            high=extent[..., 1] - centre,
            pixels=found.pixels[:, : self._objects],
            seen=found.found[:, : self._objects],
        )

    def show_objects(self, frames: UInt8[Tensor, "b h w 3"]) -> Bool[Tensor, "b h w"]:
        """Which pixels have an object's colour."""
        return self._finder.labels(frames) < self._objects

    def meet(
        self, start: UInt8[Tensor, "b h w 3"], goals: UInt8[Tensor, "b h w 3"]
    ) -> tuple[BoundingBoxes, BoundingBoxes]:
        """The objects' places at the start and at the goal; what one image hides is completed from the other."""
        first, last = self.look(start), self.look(goals)
        return self.believed(last, first), self.believed(first, last)

    def update(self, known: BoundingBoxes, frames: UInt8[Tensor, "b h w 3"]) -> BoundingBoxes:
        """The estimated places after newer images."""
        return self.believed(known, self.look(frames))

    def believed(self, known: BoundingBoxes, now: BoundingBoxes) -> BoundingBoxes:
        """The estimated places after an update.

        Args:
            known: The estimate before it.
            now: What the new images show.
        """
        full, margin = self._settings.fully_seen, self._settings.box_margin_px
        clear = now.seen & ((now.pixels >= full * known.pixels) | known.centre[..., 0].isnan())
        beyond_low = (known.low + margin - (known.centre - now.centre + now.low)).clamp(max=0)
        beyond_high = (now.centre + now.high - known.centre - known.high - margin).clamp(min=0)
        moved = (beyond_high + beyond_low).where(now.seen[..., None], torch.zeros(()).to(now.centre))
        side = clear[..., None]
        return BoundingBoxes(
            centre=torch.where(side, now.centre, known.centre + moved),
            low=torch.where(side, now.low, known.low),
            high=torch.where(side, now.high, known.high),
            pixels=torch.maximum(now.pixels, known.pixels),
            seen=now.seen,
        )


@functools.lru_cache(maxsize=8)
def _finder(spec: EnvSpec) -> PositionFinder:
    """A position finder that all trackers share, because building its table of colours takes 0.1 s [measured]."""
    return PositionFinder(spec)
