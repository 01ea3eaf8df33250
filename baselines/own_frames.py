"""Training on the model's own frames, which it meets in planning (scheduled sampling; Bengio et al. 2015).

A rollout starts from recorded frames and goes on from predicted ones, which are blurred wherever something has moved. A
model that was trained on recorded frames alone has never seen such frames, and its errors grow from step to step. Here
the last two frames of some triplets are replaced by what the model itself makes of the frames before them; it still has
to predict the recorded next frame. Which actions lead there is told as in the training: by latent actions, from pairs
of recorded frames, or by the actions that were paid for. No gradient runs through the frames that are made.

Bengio, Vinyals, Jaitly, Shazeer: Scheduled Sampling for Sequence Prediction with Recurrent Neural Networks, NeurIPS
2015. Their share of own inputs grows with the training, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import Actions
from dmotion_bench.learning.model import TripletBatch

WITH_OWN_FRAMES: Final[Any] = ("own_frames above 0", lambda config: config.own_frames > 0)
"""What ``own_steps`` needs."""


@dataclass(frozen=True)
class Step:
    """What is known of a recorded step of some triplets.

    Attributes:
        now, after: The recorded frames before and after it, packed.
        action: What was done; None to a model that does not ask for it.
    """

    now: Float[Tensor, "r p hp wp"]
    after: Float[Tensor, "r p hp wp"]
    action: Actions | None


Follow = Callable[[Tensor, Tensor, Step], Tensor]
"""Predicts the next packed frame from the last two and a recorded step."""


@dataclass(frozen=True)
class Own:
    """The model's own last two frames of some triplets of a batch.

    Attributes:
        rows: Which triplets.
        previous, current: What the model makes of their x_{t-1} and x_t, packed.
    """

    rows: Int[Tensor, " r"]
    previous: Float[Tensor, "r p hp wp"]
    current: Float[Tensor, "r p hp wp"]

    def put_into(self, previous: Tensor, current: Tensor) -> tuple[Tensor, Tensor]:
        """x_{t-1} and x_t of the batch, with these in their places."""
        return previous.index_copy(0, self.rows, self.previous), current.index_copy(0, self.rows, self.current)


class OwnFrames:
    """Chooses the triplets of a batch that are predicted from own frames, and makes these frames.

    Args:
        share: Of the triplets, at the end of the training; it grows from 0 in proportion.
        steps: At most so many predictions in a row lead to x_t; how many, is drawn for each batch.

    Raises:
        InvalidSetting: The share is not from 0 to 1, or there is no step.
    """

    def __init__(self, share: float, steps: int) -> None:
        if not 0 <= share <= 1 or steps < 1:
            raise InvalidSetting(f"own_frames is {share} (from 0 to 1), own_steps {steps} (1 or more).")
        self.share, self.steps = share, steps
        self.now = 0.0

    @property
    def earlier(self) -> int:
        """The frames before a triplet that the training needs (``Phase.earlier``)."""
        return self.steps if self.share else 0

    def progress(self, done: float) -> None:
        """How much of the training is done, from 0 to 1."""
        self.now = self.share * done

    def of(
        self, batch: TripletBatch, pack: Callable[[Tensor], Tensor], follow: Follow, *, needs_actions: bool = False
    ) -> Own | None:
        """The own frames of some of a batch's triplets; None if there are none.

        Args:
            batch: With the frames before its triplets.
            pack: Packs frames.
            follow: The model's step.
            needs_actions: Whether it needs the action of each step. A triplet before which too few were paid for then
                keeps its recorded frames.
        """
        chosen = round(self.now * len(batch.current))
        if batch.earlier is None or not chosen:
            return None
        rows = torch.randperm(len(batch.current))[:chosen].to(batch.current.device)
        steps = int(torch.randint(1, batch.earlier.shape[1] + 1, ()))
        actions: list[Actions | None] = [None] * steps
        if needs_actions:
            assert batch.earlier_action is not None, "the loop tells what was done before labelled triplets"
            assert batch.history is not None, "it comes with the earlier frames"
            rows = rows[batch.history[rows] >= steps]
            if not len(rows):
                return None
            actions = [*batch.earlier_action[rows, -steps:].unbind(1)]
        recorded = [*batch.earlier[rows, -steps:].unbind(1), batch.previous[rows], batch.current[rows]]
        with torch.no_grad():
            frames = [pack(frame) for frame in recorded]
            previous, current = frames[:2]
            for now, after, action in zip(frames[1:-1], frames[2:], actions, strict=True):
                previous, current = current, follow(previous, current, Step(now, after, action))
        return Own(rows, previous, current)
