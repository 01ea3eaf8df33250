"""A model's own predictions, continued action by action from one start image."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionTaken
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel


class Drive:
    """A sequence of predictions that a user continues one action at a time.

    Args:
        model: Aligned, in evaluation mode.
        start: What is seen at first; given to the model twice, as its last two frames.

    Attributes:
        actions: Taken since the start.
    """

    def __init__(self, model: ForwardModel[Any], start: UInt8[Tensor, "h w 3"]) -> None:
        self._model, self._start = model, start
        self.restart()

    def restart(self) -> None:
        """Back to the first picture."""
        self.actions: list[ActionTaken] = []
        self.frame = self._start
        image = to_model(self._start[None])
        with torch.inference_mode():
            self._state = self._model.begin(image, image)

    def step(self, action: ActionTaken) -> UInt8[Tensor, "h w 3"]:
        """Take an action; returns the predicted frame."""
        with torch.inference_mode():
            self._state = self._model.advance(self._state, as_tensor(np.array([action])))
            self.frame = to_pixels(self._model.frame(self._state))[0]
        self.actions.append(action)
        return self.frame


def predicted(
    model: ForwardModel[Any],
    previous: UInt8[Tensor, "h w 3"],
    current: UInt8[Tensor, "h w 3"],
    sequences: Int[Tensor, "m t"] | Float[Tensor, "m t a"],
) -> UInt8[Tensor, "m t h w 3"]:
    """The frames that a model predicts for some sequences of actions."""
    before, now = (to_model(image[None]).expand(len(sequences), -1, -1, -1) for image in (previous, current))
    with torch.inference_mode():
        return to_pixels(model.rollout(before, now, sequences))
