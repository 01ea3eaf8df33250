"""Where the agent goes while no sequence within the horizon brings an object nearer to its goal.

Five actions do not reach an object on the other side of the table, and where all plans come to the same, the first
of them is taken: the agent goes to and fro in one place until the steps are used up. Three things that pictures tell
set such plans apart:

- how near they bring the agent to where it can push what is not where it should be (``approaching.py``);
- how new what they lead to looks, above all around the objects that are not where they should be;
- whether their first action has been taken before where everything looked as it does now. A model may believe in a
  way through a wall; who has tried it knows better.

What is near or new weighs less than any gain or harm that the cost believes in. What has been tried weighs more each
time, in the end more than either: gains that do not come and harm that was only imagined keep nobody in one place for
ever.
Where every object is near its goal the agent goes back to where it has just been: what else it would push may fall.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import require_discrete
from dmotion_bench.planning.approaching import Approach
from dmotion_bench.planning.tracking import Outlines
from dmotion_bench.specs import EnvSpec

SIDE: Final = 16
"""Pictures are compared at this many pixels a side."""

SAME: Final = 2e-4
"""Pictures that differ by less look the same, as a mean squared difference in [0, 1] units; a step of the robot's arm
makes 3e-4 or more."""

VAGUE: Final = 2e-3
"""What is imagined differs by this much from what is then seen, on a good day."""

NEW: Final = 1e-2
"""A difference that is new for sure."""

PLACID: Final = 0.2
"""Both are so much smaller where nothing is sought: then the whole picture counts alike, most of it no agent."""

AROUND: Final = 0.12
"""Around an object means within this distance of it, as a share of the frame's width (a standard deviation)."""

ELSEWHERE: Final = 0.03
"""What all other places count, where those around an object count 1."""

NEAR: Final = 5 / 128
AWAY: Final = 20 / 128
"""For an object that is nearer to its goal than ``NEAR`` nothing is risked, and from ``AWAY`` on it counts in full; as
shares of the frame's width."""

NEARNESS: Final = 0.6
"""To be where a push can begin, and not a frame's width away, weighs this share of the smallest change that the cost
believes in."""

NOVELTY: Final = 0.15
"""What is new weighs at most this share of it."""

STRAYING: Final = 0.35
"""And so does leaving what has just been seen, where nothing is sought."""

WEARINESS: Final = 0.3
"""Each time that an action has been tried weighs this share of it."""


@dataclass(frozen=True, kw_only=True)
class Sights:
    """The history of some tasks: all images so far, reduced in size, and the actions between them.

    Attributes:
        pictures: Small ones, one for each moment; the last is the present.
        actions: Taken between them.
    """

    pictures: Float[Tensor, "b m d"]
    actions: Int[Tensor, "b m-1"]

    @classmethod
    def first(cls, frames: UInt8[Tensor, "b h w 3"]) -> Sights:
        """The history at the start: one image, no action."""
        return cls(pictures=small(frames)[:, None], actions=torch.zeros((len(frames), 0), dtype=torch.int64))

    def after(self, actions: Int[Tensor, " b"], frames: UInt8[Tensor, "b h w 3"]) -> Sights:
        """The history with the newest actions and images appended."""
        return Sights(
            pictures=torch.cat([self.pictures, small(frames)[:, None]], dim=1),
            actions=torch.cat([self.actions, actions[:, None]], dim=1),
        )

    def tried(self, actions: int) -> Int[Tensor, "b a"]:
        """How often each action was taken in a state that looked like the present one."""
        apart = (self.pictures[:, :-1] - self.pictures[:, -1:]).square().mean(dim=2)
        taken = (self.actions[..., None] == torch.arange(actions)) & (apart < SAME)[..., None]
        return taken.sum(dim=1)

    def to(self, device: torch.device) -> Sights:
        """The same on a device."""
        return Sights(pictures=self.pictures.to(device), actions=self.actions.to(device))


def small(frames: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n d"]:
    """Pictures at ``SIDE`` x ``SIDE`` pixels, in [0, 1]: the means of cells, of which every other row is looked at.

    The last rows and columns are left out where the cells do not fill the picture.
    """
    count, height, width = frames.shape[0], frames.shape[1] // SIDE, frames.shape[2] // SIDE
    cells = frames[:, : height * SIDE, : width * SIDE].reshape(count, SIDE, height, SIDE * width * 3)[:, :, ::2]
    rows = cells.sum(dim=2, dtype=torch.int32).reshape(count, SIDE, SIDE, width, 3)
    return rows.sum(dim=3).flatten(1).float() / (255 * cells.shape[2] * width)


def misplaced(known: Outlines, wanted: Outlines, standing: Bool[Tensor, "b k"], width: int) -> Float[Tensor, "b k"]:
    """How far each object is from its place: from 0 (in its place, or fallen) to 1.

    Args:
        known, wanted: Where the objects are, and where they should be.
        standing: Which of them are still on the table.
        width: Of a frame [px].
    """
    off = (known.centre - wanted.centre).norm(dim=-1).nan_to_num(0.0) * wanted.seen / width
    share: Tensor = (off / AWAY).clamp(max=1) * ((off > NEAR) & standing)
    return share


class Exploration:
    """Bonuses and penalties that decide between predictions of equal cost, in shares of the smallest change.

    Args:
        sights: What has been seen.
        known: Where the objects are.
        misplaced: How much each of them is sought, from 0 to 1 (``misplaced``).
        approach: The places to push them from; without it only what is new is sought.
        spec: Says how large frames are, which are square here, others are stretched; and how many actions there are.
    """

    def __init__(
        self,
        sights: Sights,
        known: Outlines,
        *,
        misplaced: Float[Tensor, "b k"],
        approach: Approach | None = None,
        spec: EnvSpec,
    ) -> None:
        place = (torch.arange(SIDE, device=misplaced.device) + 0.5) / SIDE
        centre = known.centre[..., None].nan_to_num(torch.inf) / spec.width
        across, down = (torch.exp(-(place - centre[:, :, axis]).square() / (2 * AROUND**2)) for axis in (0, 1))
        weight = ELSEWHERE + torch.einsum("bk,bky,bkx->byx", misplaced, down, across)
        weight = (weight / weight.sum(dim=(1, 2), keepdim=True) / 3).flatten(1).repeat(1, 3).sqrt()
        self._weight, self._seen = weight, sights.pictures * weight[:, None]
        self._approach, self._seeking = approach, misplaced.amax(dim=1) > 0
        self._scale = torch.where(self._seeking, 1.0, PLACID)
        tried = sights.to(torch.device("cpu")).tried(len(require_discrete(spec.actions, "planning"))).to(misplaced)
        self._weariness = WEARINESS * tried

    def appeal(self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The bonus of predicted images that are new, or that bring the agent near a place to push from."""
        appeal: Tensor = NOVELTY * self._unlike(frames, task, self._seen)
        if self._approach is not None:
            appeal = appeal + NEARNESS * self._approach.nearness(frames, task)
        return appeal * self._seeking[task]

    def reluctance(
        self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> Float[Tensor, " n"]:
        """The penalty of a first action that was tried before, or that moves away where nothing is misplaced."""
        away: Tensor = STRAYING * self._unlike(frames, task, self._seen[:, -2:])
        return torch.where(self._seeking[task], self._weariness[task, action], away)

    def _unlike(
        self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"], seen: Float[Tensor, "b m d"]
    ) -> Float[Tensor, " n"]:
        """How different each image is from all images in ``seen``, from 0 to 1."""
        own = small(frames) * self._weight[task]
        apart = (own[:, None] - seen[task]).square().sum(dim=2).amin(dim=1)
        unlike: Tensor = 1 - torch.exp((VAGUE - apart / self._scale[task]).clamp(max=0) / NEW)
        return unlike
