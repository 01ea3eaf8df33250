"""check_model refuses what a model keeps outside its weights, names that clash, and labels that nobody asked for."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from sound_models import Reading, Recurrent, Sound, SoundVideo, begun_with, breaks
from torch import nn

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.model import Losses, Phase
from dmotion_bench.testing import check_model


class Blind(Recurrent):
    """Draws no frames."""

    needs_pixels = False

    def losses(self, batch):
        after = self.advance(self.begin(batch.previous, batch.current), batch.action)[0]
        return Losses(total=(after - self.begin(batch.current, batch.next)[0]).square().mean())

    def frame(self, state):
        raise AssertionError("nobody should look")

    branch: Any = None
    pixels: Any = None


class OneCode(Reading):
    """Reads the same latent action off all frames, as a codebook does that has collapsed."""

    def _code(self, current, following):
        return super()._code(current, following) * 0


@pytest.mark.parametrize("kind", [Blind, OneCode])
def test_what_is_sound_is_neither_a_breach_nor_a_warning(kind: type) -> None:
    check_model(kind, size=16)


def _listed_blind(self: Any) -> None:
    self.more = [nn.Conv2d(4, 4, 1)]


def _steps(self: Any, batch: Any) -> Losses:
    self.taken = getattr(self, "taken", 0) + self.training
    return Losses(total=Sound.losses(self, batch).total * (1 + self.taken))


def _teaches(self: Any, batch: Any) -> Losses:
    if self.training:
        self.teacher[0].weight.data.lerp_(self.layer.weight.data, 0.1)
    off = (self.teacher[0].weight - self.layer.weight).square().mean()
    return Losses(total=Sound.losses(self, batch).total + off)


def _keeps(self: Any, batch: Any) -> Losses:
    losses = Sound.losses(self, batch)
    self.kept.append(losses.total)
    return losses


def _attached(self: Any, batch: Any) -> Losses:
    total = Sound.losses(self, batch).total
    return Losses(total=total, per_triplet=total.expand(3))


def _seeded(self: Any, config: Any, inputs: Any) -> None:
    torch.manual_seed(42)
    Sound.__init__(self, config, inputs)


GOING_ON = r"of a training that goes on from a checkpoint is .* in the phase 'train', and .* if it had not stopped"
BREACHES: dict[str, tuple[type, str]] = {
    "count of steps": (breaks(Sound, losses=_steps), GOING_ON),
    "teacher in a list": (
        breaks(
            Sound,
            __init__=begun_with(lambda self: setattr(self, "teacher", [copy.deepcopy(self.layer)])),
            losses=_teaches,
        ),
        GOING_ON,
    ),
    "losses of every step": (
        breaks(Sound, __init__=begun_with(lambda self: setattr(self, "kept", [])), losses=_keeps),
        r"losses\(batch\) keeps tensors of an earlier batch in the phase 'train', so memory grows",
    ),
    "one seed for all": (
        breaks(Sound, __init__=_seeded),
        r"__init__ seeds torch's generator, so all seeds .* the same",
    ),
    "layer with the name of an optional method": (
        breaks(Sound, __init__=begun_with(lambda self: setattr(self, "features", nn.Conv2d(3, 3, 1)))),
        r"its attribute 'features' is of the type Conv2d; this is the name of a method that a model may offer",
    ),
    "number with the name of an optional method": (
        breaks(Sound, __init__=begun_with(lambda self: setattr(self, "embedding", 16))),
        r"its attribute 'embedding' is of the type int",
    ),
    "layer with the name of a method": (
        breaks(Sound, __init__=begun_with(lambda self: setattr(self, "frame", nn.Conv2d(3, 3, 1)))),
        r"its layer 'frame' has the name of an attribute of the class, which hides it",
    ),
    "labels that nobody asked for": (
        breaks(SoundVideo, losses=lambda self, batch: Sound.losses(self, batch)),
        r"losses\(batch\) raised .*batch.action is None where supervision is Supervision.NONE",
    ),
    "labels in a phase without": (
        breaks(Sound, phases=lambda self: (Phase(name="video", fraction=0.5), Phase(fraction=0.5, needs_actions=True))),
        r"losses\(batch\) raised .*batch.action is None in this phase, and Phase\(needs_actions=True\) asks for it",
    ),
    "another type in bfloat16": (
        breaks(
            Sound,
            losses=lambda self, batch: Losses(
                total=Sound.losses(self, batch).total
                + torch.zeros(3).lerp(self.layer(batch.current.repeat(1, 4, 1, 1)[:, :10]).mean((0, 2, 3)), 0.5).sum()
            ),
        ),
        r"losses\(batch\) raised RuntimeError in bfloat16, under torch.autocast: expected dtype float",
    ),
    "losses with a gradient": (
        breaks(Sound, losses=_attached),
        r"per_triplet has a gradient; give per_triplet=each.detach\(\)",
    ),
    "list of layers, without frames": (
        breaks(
            Blind,
            __init__=begun_with(_listed_blind, Blind),
            advance=lambda self, s, a: (self.more[0](Recurrent.advance(self, s, a)[0]),),
        ),
        r"advance gives other states once its weights are saved and loaded",
    ),
    "noise, without frames": (
        breaks(Blind, advance=lambda self, s, a: (Recurrent.advance(self, s, a)[0] + torch.randn(1),)),
        r"advance differs from one call to the next",
    ),
    "no states, without frames": (
        breaks(Sound, needs_pixels=False),
        r"its needs_pixels is False and it does not define both begin and advance",
    ),
}


@pytest.mark.parametrize("name", BREACHES)
def test_every_breach_is_said(name: str) -> None:
    kind, sentence = BREACHES[name]
    with pytest.raises(ModelContractBroken, match=sentence):
        check_model(kind, size=16)
