"""What predicted frames cost in which each object is followed from step to step.

A predicted frame is no picture: what the model is not sure of is a smear, a pushed object fades and is gone a few
steps later, and the arm's blurred edges have the colours of objects that stand elsewhere. A planner that takes the
centre of all pixels of a colour looks for such stray pixels near the goal, and finds them; and if what has faded
counts as lost, no push ever looks good. What is known about objects helps (measured in ``docs/decisions``):

- from one step to the next an object does not go farther than the agent does, so only its own surroundings are
  looked at, and they move along with it;
- objects do not fade away: one that does is believed to be where it was predicted last. But one of which the first
  predicted step, which starts from real images, leaves nothing but bare ground may be lost (``occlusion.py``), and at
  the table's edge one that is carried out or gone (``falls.py``).

What is partly hidden is treated as in ``tracking.py``; of predictions that cost the same, ``exploration.py`` says
which is to be preferred. Only images are used.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.dynamics.base import Actions
from dmotion_bench.planning.objectives.base import StepCost
from dmotion_bench.planning.objectives.tabletop.exploration import Exploration
from dmotion_bench.planning.objectives.tabletop.falls import FallRisk
from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.planning.objectives.tracking import BoundingBoxes, Tracker
from dmotion_bench.specs import EnvSpec


class FollowedObjects:
    """Summed squared distances of the objects' centres, each followed step by step, from one moment on [px^2].

    What is known of an object at a step is its centre's x and y [px]; the risk that the first step lost it, NaN before
    that; and the penalty of the first action, the same for all objects.

    Args:
        settings: See there.
        spec: Says what the objects look like.
        known: Where they are now, by all that has been seen.
        wanted: Where they should be; what the goal image does not show at all does not count.
        occlusion: Without it what the first step hides may be lost, too.
        exploration: Which of the predictions that cost the same is to be preferred; without it none is.
        falls: Which objects may fall; without it only what the first step leaves nothing of may be lost.
    """

    def __init__(
        self,
        settings: TabletopSettings,
        spec: EnvSpec,
        known: BoundingBoxes,
        wanted: BoundingBoxes,
        *,
        occlusion: OcclusionModel | None = None,
        exploration: Exploration | None = None,
        falls: FallRisk | None = None,
    ) -> None:
        self._settings, self._tracker = settings, Tracker(spec, settings)
        self._known, self._wanted = known, wanted
        self._reach, self._touch = settings.search_reach * spec.width, settings.touch_distance * spec.width
        self._least = (settings.least_gain * spec.width) ** 2
        self._lost = (settings.lost_distance * spec.width) ** 2
        self._occlusion, self._exploration, self._falls = occlusion, exploration, falls
        self._now = self._apart(known.centre, wanted).sum(-1)

    def begin(self) -> Float[Tensor, "b k 4"]:
        """Where the objects of each task are."""
        return F.pad(F.pad(self._known.centre, (0, 1), value=torch.nan), (0, 1))

    def of_frames(
        self,
        frames: UInt8[Tensor, "n h w 3"],
        task: Int[Tensor, " n"],
        action: Actions,
        known: Float[Tensor, "n k 4"],
    ) -> tuple[StepCost, Float[Tensor, "n k 4"]]:
        """The cost of images, and where the objects are in them; ``action`` is the one that led to each."""
        start, wanted, still = self._known.of(task), self._wanted.of(task), self._settings.still_px
        before, risk, penalty = replace(start, centre=known[..., :2]), known[..., 2], known[..., 3]
        now = self._look(before, frames)
        centre = self._tracker.believed(before, now).centre
        moved = (centre - start.centre).norm(dim=-1, keepdim=True) >= still
        first = risk.isnan()
        if begins := bool(first.any()):
            risk = torch.where(first, self._risk(frames, task, start, now, first), risk)
        apart, feared = self._apart(torch.where(moved, centre, start.centre), wanted), self._lost * risk
        total, present = (apart + feared).sum(-1), self._now[task]
        way = torch.where(moved, (centre - start.centre).norm(dim=-1, keepdim=True), 0.0).sum(dim=(1, 2))
        idle, touched = (total - present).abs() < self._least, self._least * (way / self._touch).clamp(max=1)
        total = torch.where(idle, present + touched, total)
        bonus = torch.where(idle, -touched, 0.0)
        if self._exploration is not None:
            if begins:
                tired = self._exploration.penalty(frames, task, action)[:, None]
                penalty = torch.where(first, tired, penalty)
            reluctance = self._least * (penalty[:, 0] - self._exploration.bonus(frames, task))
            total, bonus = total + reluctance, bonus - reluctance
        cost = StepCost(
            distance=torch.where(idle, present, apart.sum(-1)),
            risk=torch.where(idle, 0.0, feared.sum(-1)),
            bonus=bonus,
            total=total,
        )
        return cost, torch.cat([centre, risk[..., None], penalty[..., None]], dim=-1)

    def _risk(
        self,
        frames: UInt8[Tensor, "n h w 3"],
        task: Int[Tensor, " n"],
        start: BoundingBoxes,
        now: BoundingBoxes,
        first: Bool[Tensor, "n k"],
    ) -> Float[Tensor, "n k"]:
        """The probability that the first step lost each object."""
        gone = start.seen & ~(now.seen & (now.pixels >= self._settings.gone_share * start.pixels))
        if bool((asked := gone & first).any()) and self._occlusion is not None:
            gone = gone & ~self._occlusion.hides(frames, task, asked)
        risk = self._settings.fall_unlikely * gone
        return risk if self._falls is None else torch.maximum(risk, self._falls.risk(frames, now, task, first))

    def _apart(self, centre: Float[Tensor, "n k 2"], wanted: BoundingBoxes) -> Float[Tensor, "n k"]:
        """The squared distance of each object from its place; zero for one that the goal does not show."""
        squared = (centre - wanted.centre).square().sum(-1).nan_to_num(self._lost)
        return torch.where(wanted.seen, squared, 0.0)

    def _look(self, before: BoundingBoxes, frames: UInt8[Tensor, "n h w 3"]) -> BoundingBoxes:
        """Find each object: near its last place, or anywhere if it is visible as a whole and in one piece."""
        near, anywhere = self._tracker.look_near(before, frames, self._reach), self._tracker.look(frames)
        largest = self._settings.turned_size * (before.low + before.high) + self._settings.box_margin_px
        whole = anywhere.pixels >= self._settings.fully_seen * before.pixels
        in_one_piece = whole & (anywhere.low + anywhere.high <= largest).all(-1)
        return anywhere.where(anywhere.seen & in_one_piece, near)
