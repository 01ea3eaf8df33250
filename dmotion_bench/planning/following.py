"""The cost of predicted frames in which each object is followed from step to step.

A predicted frame is no picture: what the model is not sure of is a smear, a pushed object fades and is gone a few
steps later, and the arm's blurred edges have the colours of objects that stand elsewhere. A planner that takes the
centre of all pixels of a colour looks for such stray pixels near the goal, and finds them; and if what has faded
counts as lost, no push ever looks good. What is known about objects helps (measured in DECISIONS.md):

- from one step to the next an object does not go farther than the agent does, so only its own surroundings are
  looked at, and they move along with it;
- objects do not fade away: one that does is believed to be where it was imagined last. But one of which the first
  imagined step, which is predicted from real pictures, leaves nothing but bare ground may be lost (``covering.py``),
  and at the table's edge one that is carried out or gone (``edges.py``).

What is partly hidden is treated as in ``tracking.py``; of futures that cost the same, ``exploring.py`` says which is
to be preferred. Nothing but pictures is looked at.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ForwardModel, State
from dmotion_bench.planning.covering import Ground
from dmotion_bench.planning.edges import GONE, UNLIKELY, Edges
from dmotion_bench.planning.exploring import Exploration
from dmotion_bench.planning.tracking import CLEAR, PLAY, Outlines, Tracker, believed
from dmotion_bench.specs import EnvSpec

REACH: Final = 6 / 128
"""So far beyond its outline an object is looked for, as a share of the frame's width."""

STILL: Final = 1.0
"""What is imagined to have moved less than this since the last real picture has not moved [px]."""

DOUBT: Final = 4 / 128
"""Whatever changes the cost by less than this share of the frame's width, as a distance, is not believed."""

TOUCH: Final = 4 / 128
"""Objects that are imagined to move so far in all, as a share of the frame's width, and bring nothing thereby, cost as
much as a change that is not believed: what is imagined of a first touch is too little."""

LOST: Final = 0.5
"""What a missing object costs: this share of the frame's width, as a distance. One that may be lost costs as much of
that as is to be feared, on top of its own distance, so what gains more may be done."""

LOOSE: Final = 1.5
"""So much longer and wider than before may an object be that is seen in one piece: it may have turned."""


@runtime_checkable
class Following(Protocol):
    """A cost that carries information from each predicted step to the next."""

    def begin(self) -> Tensor:
        """The information about each task before the first predicted step."""

    def follow(
        self,
        model: ForwardModel[Any],
        state: State,
        task: Int[Tensor, " n"],
        action: Int[Tensor, " n"],
        known: Tensor,
    ) -> tuple[Float[Tensor, " n"], Tensor]:
        """The cost of some predicted states, and the information to carry on to the next step.

        ``action`` is the one that led to each.
        """


class FollowedCost:
    """Summed squared distances of the objects' centres, each followed step by step [px^2].

    What is known of an object at a step is its centre's x and y [px]; the chance that the first step lost it, NaN
    before that; and how reluctantly the first action is taken, the same for all objects.

    Args:
        spec: Says what the objects look like.
        known: Where they are now, by all that has been seen.
        wanted: Where they should be; what the goal image does not show at all does not count.
        ground: What they stand on; without it what the first step covers may be lost, too.
        exploration: Which of the futures that cost the same is to be preferred; without it none is.
        edges: Which objects may fall; without it only what the first step leaves nothing of may be lost.
    """

    def __init__(
        self,
        spec: EnvSpec,
        known: Outlines,
        wanted: Outlines,
        *,
        reach: float = REACH,
        still: float = STILL,
        doubt: float = DOUBT,
        ground: Ground | None = None,
        exploration: Exploration | None = None,
        edges: Edges | None = None,
    ) -> None:
        self._tracker, self._known, self._wanted = Tracker(spec), known, wanted
        self._reach, self._still, self._doubt = reach * spec.width, still, (doubt * spec.width) ** 2
        self._touch = TOUCH * spec.width
        self._lost = (LOST * spec.width) ** 2
        self._ground, self._exploration, self._edges = ground, exploration, edges
        self._now = self._apart(known.centre, wanted, torch.zeros_like(known.centre[..., 0]))

    def begin(self) -> Float[Tensor, "b k 4"]:
        """Where the objects of each task are."""
        return F.pad(F.pad(self._known.centre, (0, 1), value=torch.nan), (0, 1))

    def follow(
        self,
        model: ForwardModel[Any],
        state: State,
        task: Int[Tensor, " n"],
        action: Int[Tensor, " n"],
        known: Float[Tensor, "n k 4"],
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n k 4"]]:
        """The cost of the frames that the states look like, and where the objects are in them."""
        return self.of_frames(to_pixels(model.frame(state)), task, action, known)

    def of_frames(
        self,
        frames: UInt8[Tensor, "n h w 3"],
        task: Int[Tensor, " n"],
        action: Int[Tensor, " n"],
        known: Float[Tensor, "n k 4"],
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n k 4"]]:
        """The cost of pictures, and where the objects are in them."""
        start, wanted = self._known.of(task), self._wanted.of(task)
        before, risk, reluctance = replace(start, centre=known[..., :2]), known[..., 2], known[..., 3]
        now = self._look(before, frames)
        centre = believed(before, now).centre
        moved = (centre - start.centre).norm(dim=-1, keepdim=True) >= self._still
        first = risk.isnan()
        gone = start.seen & ~(now.seen & (now.pixels >= GONE * start.pixels))
        if bool((asked := gone & first).any()) and self._ground is not None:
            gone = gone & ~self._ground.covered(frames, task, asked)
        chance = UNLIKELY * gone
        if self._edges is not None:
            chance = torch.maximum(chance, self._edges.risk(frames, now, task, first))
        if self._exploration is not None:
            tired = self._exploration.reluctance(frames, task, action)[:, None]
            reluctance = torch.where(first, tired, reluctance)
        risk = torch.where(first, chance, risk)
        cost = self._apart(torch.where(moved, centre, start.centre), wanted, risk)
        present = self._now[task]
        distance = torch.where(moved, (centre - start.centre).norm(dim=-1, keepdim=True), 0.0).sum(dim=(1, 2))
        idle = (cost - present).abs() < self._doubt
        cost = torch.where(idle, present + self._doubt * (distance / self._touch).clamp(max=1), cost)
        if self._exploration is not None:
            cost = cost + self._doubt * (reluctance[:, 0] - self._exploration.appeal(frames, task))
        return cost, torch.cat([centre, risk[..., None], reluctance[..., None]], dim=-1)

    def _apart(
        self, centre: Float[Tensor, "n k 2"], wanted: Outlines, risk: Float[Tensor, "n k"]
    ) -> Float[Tensor, " n"]:
        squared = (centre - wanted.centre).square().sum(-1).nan_to_num(self._lost)
        return (torch.where(wanted.seen, squared, 0.0) + self._lost * risk).sum(-1)

    def _look(self, before: Outlines, frames: UInt8[Tensor, "n h w 3"]) -> Outlines:
        """Find each object: near its last place, or anywhere if it is visible as a whole and in one piece."""
        near, anywhere = self._tracker.look_near(before, frames, self._reach), self._tracker.look(frames)
        largest = LOOSE * (before.low + before.high) + PLAY
        whole = (anywhere.pixels >= CLEAR * before.pixels) & (anywhere.low + anywhere.high <= largest).all(-1)
        return anywhere.where(anywhere.seen & whole, near)
