"""What a model is after a few steps of training: aligned, kept by its checkpoint, and dependent on actions."""

from __future__ import annotations

from typing import Any

import torch

from dmotion_bench.learning.model import ForwardModel, Phase
from dmotion_bench.specs import Supervision
from dmotion_bench.testing.losses import batch_of, losses_of
from dmotion_bench.testing.prediction import PREDICT
from dmotion_bench.testing.trial import BATCH, ModelTrial, differing

WARM_UP = 3  # steps of training before it is asked whether demonstrations teach anything
ROUNDING = 1e-5  # of a predicted value; images are from -1 to 1
ANOTHER_SEED = 1  # of the weights of a model into which others are loaded


def check_alignment(subject: ModelTrial) -> None:
    """Check that ``align`` learns from the demonstrations' actions, and that a checkpoint keeps the result."""
    model, other = _two_aligned(subject, steps=0)
    if subject.kind.supervision is not Supervision.NONE:
        return
    if not subject.has_one_action and not differing(model.state_dict(), other.state_dict()):
        # a spatial transformer starts at the identity: before any training every demonstration shows the same motion
        model, other = _two_aligned(subject, steps=WARM_UP)
    subject.require(
        subject.has_one_action or bool(differing(model.state_dict(), other.state_dict())),
        "align(demonstrations) leaves the same state whichever actions are shown, so it learns nothing that is kept: "
        "what it learns must be in buffers or parameters",
    )
    subject.require(
        _is_kept(subject, model), "what align(demonstrations) learned is lost when the weights are saved and loaded"
    )


def check_checkpoint(subject: ModelTrial) -> None:
    """Check that another process, which built the model anew, predicts the same with the trained weights."""
    subject.require(
        _is_kept(subject, _aligned(subject, steps=WARM_UP), seed=ANOTHER_SEED),
        "predict gives other frames once its weights are saved and loaded into a model built anew; whatever it "
        "predicts with must be in parameters or buffers: layers in a list in nn.ModuleList, random or learned numbers "
        "in register_buffer",
    )


def _is_kept(subject: ModelTrial, model: ForwardModel[Any], *, seed: int = 0) -> bool:
    """Whether a model predicts the same, but for rounding, once its weights are loaded into another one.

    The rounding depends on where in memory the weights lie.
    """
    kept = subject.build(seed=seed).eval()
    with subject.calling("load_state_dict"):
        kept.load_state_dict(model.state_dict())
    inputs = (subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH))
    with torch.inference_mode(), subject.calling(PREDICT):
        return torch.allclose(model.eval().predict(*inputs), kept.predict(*inputs), rtol=0, atol=ROUNDING)


def tells_actions_apart(subject: ModelTrial, steps: int) -> bool:
    """Whether the frames that a model predicts after so many steps of training depend on the action."""
    model = _aligned(subject, steps=steps)
    previous, current, usual = subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH)
    others = [other for shift in range(1, 4) if not torch.equal(other := subject.actions(BATCH, shift), usual)]
    with torch.inference_mode(), subject.calling(PREDICT):
        frames = model.predict(previous, current, usual)
        return not others or any(not torch.equal(model.predict(previous, current, one), frames) for one in others)


def _two_aligned(subject: ModelTrial, *, steps: int) -> tuple[ForwardModel[Any], ForwardModel[Any]]:
    """Two models trained alike, and aligned with the same frames and other actions; a third with one of each."""
    models = _aligned(subject, steps=steps), _aligned(subject, steps=steps, shift=1)
    with torch.no_grad(), subject.calling("align(demonstrations)"):
        subject.build().eval().align(subject.demonstrations(each=1))
    return models


def _aligned(subject: ModelTrial, *, steps: int, shift: int = 0) -> ForwardModel[Any]:
    """A model after so many steps of training in each phase, aligned, in evaluation mode."""
    model = subject.build()
    for phase in model.phases():
        with subject.calling(f"enter({phase.name!r})"):
            model.train().enter(phase)
        optimizer = torch.optim.Adam((one for one in model.parameters() if one.requires_grad), lr=1e-2)
        for step in range(steps):
            with subject.calling(f"progress({step / steps})"):
                model.progress(step / steps)
            losses = losses_of(
                subject, model, batch_of(subject, phase), seed=step, of=f"after {step} steps of training"
            )
            with subject.calling("losses(batch).total.backward()"):
                losses.total.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            optimizer.zero_grad()
        _require_entered_again(subject, model, phase)
    with torch.no_grad(), subject.calling("align(demonstrations)"):
        model.eval().align(subject.demonstrations(each=2, shift=shift))
    return model


def _require_entered_again(subject: ModelTrial, model: ForwardModel[Any], phase: Phase) -> None:
    """Check that what a phase has taught outlasts another ``enter``."""
    learned = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    with subject.calling(f"enter({phase.name!r})"):
        model.enter(phase)
    changed = differing(learned, model.state_dict())
    subject.require(
        not changed,
        f"enter({phase.name!r}) changes {changed}; it is called again on resuming and after each validation, so it "
        "may only freeze and unfreeze, and what is to happen once belongs to progress(0.0)",
    )
