"""Where the agent goes while no sequence within the horizon brings an object nearer to its goal.

A few actions do not reach an object on the other side of the table, and where all plans come to the same, the first
of them is taken: the agent goes to and fro in one place until the steps are used up. Three things that images tell
set such plans apart:

- how near they bring the agent to where it can push a misplaced object (``push_pose.py``);
- how new what they lead to looks, above all around the misplaced objects;
- whether their first action has been taken before where everything looked as it does now. A model may believe in a
  way through a wall; whoever has tried it knows better.

What is near or new weighs less than any gain or harm that the cost believes in. What has been tried weighs more each
time, in the end more than either: gains that do not come and harm that was only predicted keep nobody in one place
for ever. Where every object is near its goal the agent goes back to where it has just been: what else it would push
may fall.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.dynamics.base import Actions
from dmotion_bench.planning.objectives.tabletop.push_pose import PushPoseBonus
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.planning.objectives.tracking import BoundingBoxes
from dmotion_bench.specs import EnvSpec


@dataclass(frozen=True, kw_only=True)
class History:
    """The history of some tasks: all images so far, reduced in size, and the actions between them.

    Attributes:
        images: Small ones, one for each moment; the last is the present.
        actions: Taken between them; continuous ones in [-1, 1].
        side: Pixels a side of the small images.
    """

    images: Float[Tensor, "b m d"]
    actions: Int[Tensor, "b m-1"] | Float[Tensor, "b m-1 a"]
    side: int

    @classmethod
    def first(cls, frames: UInt8[Tensor, "b h w 3"], side: int, spec: ActionSpec) -> History:
        """The history at the start: one image, no action."""
        kind = torch.int64 if isinstance(spec, Discrete) else torch.float32
        actions = torch.zeros((len(frames), 0, *spec.shape), dtype=kind)
        return cls(images=reduced(frames, side)[:, None], actions=actions, side=side)

    def after(self, actions: Actions, frames: UInt8[Tensor, "b h w 3"]) -> History:
        """The history with the newest actions and images appended."""
        return History(
            images=torch.cat([self.images, reduced(frames, self.side)[:, None]], dim=1),
            actions=torch.cat([self.actions, actions[:, None]], dim=1),
            side=self.side,
        )

    def looked_alike(self, same: float) -> Bool[Tensor, "b p"]:
        """Which moments before the present looked like it: images that differ by less than ``same``."""
        apart: Float[Tensor, "b p"] = (self.images[:, :-1] - self.images[:, -1:]).square().mean(dim=2)
        return apart < same


def reduced(frames: UInt8[Tensor, "n h w 3"], side: int) -> Float[Tensor, "n d"]:
    """Images at ``side`` x ``side`` pixels, in [0, 1]: the means of cells, of which every other row is looked at.

    The last rows and columns are left out where the cells do not fill the image.
    """
    count, height, width = frames.shape[0], frames.shape[1] // side, frames.shape[2] // side
    planes = frames.movedim(-1, 1)[:, :, : height * side, : width * side]
    cells = planes.reshape(count, 3, side, height, side * width)[:, :, :, ::2]
    sums = cells.sum(dim=3, dtype=torch.int32).reshape(count, 3, side, side, width).sum(dim=4)
    return sums.movedim(1, -1).flatten(1).float() / (255 * cells.shape[3] * width)


def misplaced(
    settings: TabletopSettings, known: BoundingBoxes, wanted: BoundingBoxes, standing: Bool[Tensor, "b k"], width: int
) -> Float[Tensor, "b k"]:
    """How far each object is from its place: from 0 (in its place, or fallen) to 1.

    Args:
        settings: See there.
        known, wanted: Where the objects are, and where they should be.
        standing: Which of them are still on the table.
        width: Of a frame [px].
    """
    off = (known.centre - wanted.centre).norm(dim=-1).nan_to_num(0.0) * wanted.seen / width
    share: Tensor = (off / settings.misplaced_from).clamp(max=1) * ((off > settings.placed_within) & standing)
    return share


class Exploration:
    """Bonuses and penalties that decide between predictions of equal cost, in shares of the smallest change.

    Args:
        settings: See there.
        history: What has been seen and done.
        known: Where the objects are, on the device of the predictions.
        misplaced: How much each of them is sought, from 0 to 1 (``misplaced``).
        push_poses: The places to push them from; without it only what is new is sought.
        spec: Says how large frames are, which are square here, others are stretched.
    """

    def __init__(
        self,
        settings: TabletopSettings,
        history: History,
        known: BoundingBoxes,
        *,
        misplaced: Float[Tensor, "b k"],
        push_poses: PushPoseBonus | None = None,
        spec: EnvSpec,
    ) -> None:
        side, images = history.side, history.images.to(misplaced.device)
        place = (torch.arange(side, device=misplaced.device) + 0.5) / side
        centre, spread = known.centre[..., None].nan_to_num(torch.inf) / spec.width, 2 * settings.around_std**2
        across, down = (torch.exp(-(place - centre[:, :, axis]).square() / spread) for axis in (0, 1))
        weight = settings.elsewhere_weight + torch.einsum("bk,bky,bkx->byx", misplaced, down, across)
        weight = (weight / weight.sum(dim=(1, 2), keepdim=True) / 3).flatten(1).repeat(1, 3).sqrt()
        self._settings, self._side = settings, side
        self._weight, self._seen = weight, images * weight[:, None]
        self._push_poses, self._seeking = push_poses, misplaced.amax(dim=1) > 0
        self._scale = torch.where(self._seeking, 1.0, settings.settled_scale)
        self._alike = history.looked_alike(settings.same_image).to(misplaced.device)
        self._actions = history.actions.to(misplaced.device)

    def bonus(self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The bonus of predicted images that are new, or that bring the agent near a place to push from."""
        bonus: Tensor = self._settings.novelty_bonus * self._unlike(frames, task, self._seen)
        if self._push_poses is not None:
            bonus = bonus + self._settings.push_pose_bonus * self._push_poses.nearness(frames, task)
        return bonus * self._seeking[task]

    def penalty(
        self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"], action: Actions
    ) -> Float[Tensor, " n"]:
        """The penalty of a first action that was tried before, or that moves away where nothing is misplaced."""
        away: Tensor = self._settings.leave_penalty * self._unlike(frames, task, self._seen[:, -2:])
        revisits: Tensor = self._settings.revisit_penalty * self.tried(task, action)
        return torch.where(self._seeking[task], revisits, away)

    def tried(self, task: Int[Tensor, " n"], action: Actions) -> Float[Tensor, " n"]:
        """How often each action was taken where everything looked as it does now."""
        past = self._actions[task]
        if action.ndim == 1:
            same = past == action[:, None]
        else:
            same = (past - action[:, None]).norm(dim=2) < self._settings.same_action
        return (same & self._alike[task]).sum(dim=1).float()

    def _unlike(
        self, frames: UInt8[Tensor, "n h w 3"], task: Int[Tensor, " n"], seen: Float[Tensor, "b m d"]
    ) -> Float[Tensor, " n"]:
        """How different each image is from all images in ``seen``, from 0 to 1."""
        own = reduced(frames, self._side) * self._weight[task]
        apart = (own[:, None] - seen[task]).square().sum(dim=2).amin(dim=1)
        error, new = self._settings.prediction_error, self._settings.new_image
        unlike: Tensor = 1 - torch.exp((error - apart / self._scale[task]).clamp(max=0) / new)
        return unlike
