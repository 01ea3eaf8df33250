"""A training step: it must not wait for the device, and its figures are those of its losses."""

from __future__ import annotations

import contextlib
from importlib.metadata import entry_points

import numpy as np
import pytest
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.entry_points import MODELS
from dmotion_bench.learning.model import Losses, ModelInputs, TripletBatch
from dmotion_bench.learning.training.figures import StepFigures
from dmotion_bench.learning.training.optimizer import optimizer_of
from dmotion_bench.learning.training.step import Stepper
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Preset, Supervision

NAMES = sorted(point.name for point in entry_points(group=MODELS) if point.value.startswith("baselines."))
SIDE, BATCH, ACTIONS = 32, 8, 4
NOWHERE = torch.device("meta")
"""A device that computes no numbers: whoever reads one from it, as ``float(loss)`` does, gets an error."""


def _batch(labelled: bool) -> TripletBatch:
    frames = [torch.empty(BATCH, 3, SIDE, SIDE, device=NOWHERE) for _ in range(3)]
    action = torch.zeros(BATCH, dtype=torch.long, device=NOWHERE) if labelled else None
    episode = torch.zeros(BATCH, dtype=torch.long, device=NOWHERE)
    return TripletBatch(previous=frames[0], current=frames[1], next=frames[2], action=action, episode=episode)


@pytest.fixture
def no_autocast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch raises an error where a device has no autocast."""
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda _: False)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())


@pytest.fixture
def not_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch has no fused Adam for this device; the one of single operations reads as few numbers."""
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *given, **named: adam(*given, **named | {"fused": False}))


@pytest.mark.slow
@pytest.mark.usefixtures("no_autocast", "not_fused")
@pytest.mark.parametrize("name", NAMES)
def test_a_step_reads_no_number_from_the_device(name: str) -> None:
    kind = model_class(name)
    config = kind.training_defaults(Preset.SMALL, kind.architectures[0])
    inputs = ModelInputs(height=SIDE, width=SIDE, actions=Discrete.numbered(ACTIONS))
    model = kind(kind.configure(kind.architectures[0]), inputs).to(NOWHERE).train()
    optimizer = optimizer_of(model, config)
    step = Stepper(
        model=model,
        losses=model.losses,
        backward=torch.autograd.backward,
        optimizer=optimizer,
        clip_norm=config.clip_norm,
        seed=0,
        device=NOWHERE,
    )
    for number, phase in enumerate(model.phases()):
        model.enter(phase)
        model.progress(0.5)
        batch = _batch(phase.needs_actions or kind.supervision is Supervision.ACTIONS)
        for _ in range(2):
            step(batch, number, "float32")
        optimizer.load_state_dict(optimizer.state_dict())  # as a training that goes on does
        figures = step(batch, number, "float32")
        with pytest.raises(RuntimeError, match="meta"):
            _ = figures.terms  # the test would notice


def test_figures_are_those_of_the_losses() -> None:
    each = torch.tensor([1.5, 2.5], dtype=torch.bfloat16)
    losses = Losses(total=torch.tensor(0.1, requires_grad=True), terms={"part": each.mean()}, per_triplet=each)
    figures = StepFigures(losses)
    assert figures.terms == {"loss": losses.total.item(), "part": 2.0}
    assert figures.per_triplet is not None
    np.testing.assert_array_equal(figures.per_triplet, np.array([1.5, 2.5], np.float32))
    assert StepFigures(Losses(total=losses.total)).per_triplet is None
