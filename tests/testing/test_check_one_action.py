"""check_model where there is a single action: what cannot be told apart is not asked for, and all else is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from sound_models import Sound, SoundVideo, breaks
from torch import nn

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.model import Losses, ModelInputs, Phase
from dmotion_bench.testing import check_before_training


class Inverse(Sound):
    """Learns first which action was taken, then what it does."""

    def __init__(self, config, inputs) -> None:
        super().__init__(config, inputs)
        self.code, self.inverting = nn.Linear(3, len(inputs.actions)), False

    def phases(self):
        return Phase(name="inverse", fraction=0.5, needs_actions=True), Phase(name="forward", fraction=0.5)

    def enter(self, phase) -> None:
        self.inverting = phase.name == "inverse"

    def losses(self, batch):
        scores = self.code((batch.next - batch.current).mean((2, 3)))
        if self.inverting:
            return Losses(total=nn.functional.cross_entropy(scores, batch.action))
        return Losses(total=(self._next(batch.previous, batch.current, scores.argmax(1)) - batch.next).square().mean())


@pytest.mark.parametrize("kind", [SoundVideo, Inverse])
def test_a_single_action_teaches_nothing_and_that_is_no_breach(kind: type) -> None:
    check_before_training(kind, "compact", ModelInputs(height=16, width=16, actions=Discrete.numbered(1)))


def test_with_a_single_action_what_else_is_asked_stays() -> None:
    one = ModelInputs(height=16, width=16, actions=Discrete.numbered(1))
    resting = breaks(
        Sound, phases=lambda self: (Phase(name="a", fraction=0.5, needs_actions=True), Phase(fraction=0.5))
    )
    resting.losses = lambda self, batch: Losses(total=0.0 * Sound.losses(self, self._told(batch)).total)
    resting._told = lambda self, batch: replace(batch, action=torch.zeros(len(batch.current), dtype=torch.long))
    with pytest.raises(ModelContractBroken, match="no parameter gets a gradient in the phase 'train'"):
        check_before_training(resting, "compact", one)
    forgetful = breaks(SoundVideo, __init__=_unkept)
    with pytest.raises(ModelContractBroken, match=r"what align\(demonstrations\) learned is lost"):
        check_before_training(forgetful, "compact", one)


def _unkept(self: Any, config: Any, inputs: Any) -> None:
    SoundVideo.__init__(self, config, inputs)
    self.register_buffer("table", torch.zeros(len(inputs.actions), 3), persistent=False)
