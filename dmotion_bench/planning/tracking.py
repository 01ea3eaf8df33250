"""Where the objects of some tasks are, as far as pictures tell, also where the agent stands before them.

The centre of an object's visible pixels moves when something passes in front of it, by up to half the object. A
planner that believes it finds the agent's place that hides the right half of an object better than any push, and
stays there. So an object that is not fully seen is believed to be where it was last seen, moved by no more than it
takes for what is visible of it to lie within its outline then. Nothing but pictures is looked at.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import Final

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.positions import PositionFinder, Positions
from dmotion_bench.specs import EnvSpec

CLEAR: Final = 0.85
"""The share of an object's usual pixels from which on it counts as fully seen."""

PLAY: Final = 1.0
"""So far may a visible part lie outside the outline [px]: predicted edges are not sharp."""


@dataclass(frozen=True, kw_only=True)
class Outlines:
    """Where things are [px].

    Attributes:
        centre: (x, y).
        low, high: How far their outlines reach to the left and the top, to the right and the bottom, of the centre.
        pixels: How many they have when nothing hides them.
        seen: Whether anything is seen of them now.
    """

    centre: Float[Tensor, "b k 2"]
    low: Float[Tensor, "b k 2"]
    high: Float[Tensor, "b k 2"]
    pixels: Int[Tensor, "b k"]
    seen: Bool[Tensor, "b k"]

    def to(self, device: torch.device) -> Outlines:
        """The same on a device."""
        return Outlines(**{one.name: getattr(self, one.name).to(device) for one in fields(self)})

    def of(self, rows: Int[Tensor, " n"]) -> Outlines:
        """Those of some tasks, one for each number."""
        rows = rows.to(self.centre.device)
        return Outlines(
            centre=self.centre[rows],
            low=self.low[rows],
            high=self.high[rows],
            pixels=self.pixels[rows],
            seen=self.seen[rows],
        )

    def where(self, chosen: Bool[Tensor, "b k"], other: Outlines) -> Outlines:
        """These for the objects chosen, else those of ``other``."""
        pairs = {one.name: (getattr(self, one.name), getattr(other, one.name)) for one in fields(self)}
        return Outlines(
            **{
                name: torch.where(chosen if mine.ndim == 2 else chosen[..., None], mine, theirs)
                for name, (mine, theirs) in pairs.items()
            }
        )


class Tracker:
    """Follows the objects from picture to picture.

    Args:
        spec: Says what they look like; it must have some.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self._finder, self._objects = _finder(spec), len(spec.objects)

    def look(self, frames: UInt8[Tensor, "b h w 3"]) -> Outlines:
        """What pictures show by themselves; an object that is not found has no centre (NaN)."""
        found, extents = self._finder.find_extents(frames)
        return self._outlines(found, extents)

    def look_near(self, known: Outlines, frames: UInt8[Tensor, "b h w 3"], reach: float) -> Outlines:
        """What pictures show of each object where it was and around it, as far as ``reach`` [px] goes."""
        low, high = known.centre - known.low - reach, known.centre + known.high + reach
        return self._outlines(*self._finder.find_within(frames, low, high))

    def _outlines(self, found: Positions, extents: Float[Tensor, "b k 2 2"]) -> Outlines:
        centre, extent = found.centre[:, : self._objects], extents[:, : self._objects]
        return Outlines(
            centre=centre,
            low=centre - extent[..., 0],
            high=extent[..., 1] - centre,
            pixels=found.pixels[:, : self._objects],
            seen=found.found[:, : self._objects],
        )

    def show_objects(self, frames: UInt8[Tensor, "b h w 3"]) -> Bool[Tensor, "b h w"]:
        """Which pixels have an object's colour."""
        return self._finder.labels(frames) < self._objects

    def meet(self, start: UInt8[Tensor, "b h w 3"], goals: UInt8[Tensor, "b h w 3"]) -> tuple[Outlines, Outlines]:
        """Where things are at the start and at the goal, each helped by the other where something is hidden."""
        first, last = self.look(start), self.look(goals)
        return believed(last, first), believed(first, last)

    def follow(self, known: Outlines, frames: UInt8[Tensor, "b h w 3"]) -> Outlines:
        """Where things are believed to be when pictures come after what was known."""
        return believed(known, self.look(frames))


@functools.lru_cache(maxsize=8)
def _finder(spec: EnvSpec) -> PositionFinder:
    """The same for all trackers: its table of colours takes 0.1 s, and every control step needs it [measured]."""
    return PositionFinder(spec)


def believed(known: Outlines, now: Outlines) -> Outlines:
    """Where things are after what was known, if ``now`` is what a picture shows by itself."""
    clear = now.seen & ((now.pixels >= CLEAR * known.pixels) | known.centre[..., 0].isnan())
    beyond_low = (known.low + PLAY - (known.centre - now.centre + now.low)).clamp(max=0)
    beyond_high = (now.centre + now.high - known.centre - known.high - PLAY).clamp(min=0)
    moved = (beyond_high + beyond_low).where(now.seen[..., None], torch.zeros(()).to(now.centre))
    side = clear[..., None]
    return Outlines(
        centre=torch.where(side, now.centre, known.centre + moved),
        low=torch.where(side, now.low, known.low),
        high=torch.where(side, now.high, known.high),
        pixels=torch.maximum(now.pixels, known.pixels),
        seen=now.seen,
    )
