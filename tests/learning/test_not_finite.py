"""A validation loss that is no number: the training diverged, or the model fails in its validation alone."""

from __future__ import annotations

import math

import torch
from sound_models import Sound, SoundConfig

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.learning.training.validation import why_not_finite


def test_finite_weights_point_at_the_model_and_others_at_the_rate() -> None:
    model = Sound(SoundConfig(), ModelInputs(height=16, width=16, actions=Discrete.numbered(4)))
    said = why_not_finite(model, math.nan, 7)
    with torch.no_grad():
        next(model.parameters()).fill_(math.inf)

    assert said == (
        "the validation loss is nan after step 7, although all weights are finite: Sound.losses gives no finite number "
        "in evaluation mode, or for some frames."
    )
    assert "training diverged before step 7: the loss is nan. Try a lower rate" in why_not_finite(model, math.nan, 7)
