"""What a model is after a few steps of training: aligned, kept by its checkpoint, and dependent on actions."""

from __future__ import annotations

import gc
import weakref
from typing import Any

import torch
from torch import Tensor

from dmotion_bench.learning.model import ForwardModel, Phase
from dmotion_bench.scoring.latent_models import LatentActionModel
from dmotion_bench.specs import Supervision
from dmotion_bench.testing.losses import NEAR, batch_of, entered, losses_of
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
        subject.has_one_action
        or bool(differing(model.state_dict(), other.state_dict()))
        or _reads_one_latent(subject, model),
        "align(demonstrations) leaves the same state whichever actions are shown, so it learns nothing that is kept: "
        "what it learns must be in buffers or parameters",
    )
    subject.require(
        _is_kept(subject, model), "what align(demonstrations) learned is lost when the weights are saved and loaded"
    )


def check_checkpoint(subject: ModelTrial) -> None:
    """Check that another process, which built the model anew, predicts the same with the trained weights."""
    named, given = subject.predicts
    subject.require(
        _is_kept(subject, _aligned(subject, steps=WARM_UP), seed=ANOTHER_SEED),
        f"{named} gives other {given}s once its weights are saved and loaded into a model built anew; whatever it "
        "predicts with must be in parameters or buffers: layers in a list in nn.ModuleList, random or learned numbers "
        "in register_buffer",
    )


def check_going_on(subject: ModelTrial) -> None:
    """Check that a training goes on from a checkpoint as if it had not stopped, and keeps no batch in memory."""
    for phase in subject.build().phases():
        model = _trained(subject, subject.build(), phase, WARM_UP)
        resumed = subject.build(seed=ANOTHER_SEED)
        with subject.calling("load_state_dict"):
            resumed.load_state_dict(model.state_dict())
        unstopped, after = (_next_loss(subject, one, phase) for one in (model, resumed))
        subject.require(
            torch.allclose(unstopped, after, rtol=NEAR, atol=0),
            f"losses(batch) of a training that goes on from a checkpoint is {float(after):.6g} in the phase "
            f"{phase.name!r}, and {float(unstopped):.6g} if it had not stopped; what losses knows of earlier steps, "
            "such as a teacher, a mean or a count, must be in parameters or buffers, and what depends on time alone "
            "comes to progress(share)",
        )


def _next_loss(subject: ModelTrial, model: ForwardModel[Any], phase: Phase) -> Tensor:
    with subject.calling(f"enter({phase.name!r})"):
        model.train().enter(phase)
    with subject.calling("progress(0.5)"):
        model.progress(0.5)
    return losses_of(subject, model, batch_of(subject, phase)).total.detach()


def check_memory(subject: ModelTrial) -> None:
    """Check that a model lets go of a batch and of its losses, so that memory does not grow from step to step."""
    for phase in subject.build().phases():
        model = entered(subject, phase, training=True)
        with subject.calling("progress(0.0)"):
            model.progress(0.0)
        first = batch_of(subject, phase)
        losses = losses_of(subject, model, first)
        held = [weakref.ref(one) for one in (first.current, first.next, losses.total)]
        del first, losses
        losses_of(subject, model, batch_of(subject, phase))
        if any(one() is not None for one in held):
            gc.collect()  # they may wait for it in a cycle; it takes a second where many objects live
        subject.require(
            all(one() is None for one in held),
            f"losses(batch) keeps tensors of an earlier batch in the phase {phase.name!r}, so memory grows with every "
            "step; keep numbers, as float(loss), or copies in buffers",
        )


def _reads_one_latent(subject: ModelTrial, model: ForwardModel[Any]) -> bool:
    """Whether a model reads the same latent action off all demonstrations, as one of few codes may at first."""
    reader: object = model
    if not isinstance(reader, LatentActionModel):
        return False
    shown = subject.demonstrations(each=2)
    with torch.no_grad(), subject.calling("latent_action(previous, current, following)"):
        latent = reader.latent_action(shown.previous, shown.current, shown.next)
    return bool((latent == latent[:1]).all())


def _is_kept(subject: ModelTrial, model: ForwardModel[Any], *, seed: int = 0) -> bool:
    """Whether a model predicts the same, but for rounding, once its weights are loaded into another one.

    The rounding depends on where in memory the weights lie.
    """
    kept = subject.build(seed=seed).eval()
    with subject.calling("load_state_dict"):
        kept.load_state_dict(model.state_dict())
    inputs = (subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH))
    with torch.inference_mode(), subject.calling(subject.prediction):
        before, after = (subject.look_ahead(one, *inputs) for one in (model.eval(), kept))
    return torch.allclose(before, after, rtol=0, atol=ROUNDING)


def tells_actions_apart(subject: ModelTrial, steps: int) -> bool:
    """Whether the frames that a model predicts after so many steps of training depend on the action."""
    model = _aligned(subject, steps=steps)
    previous, current, usual = subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH)
    others = [other for shift in range(1, 4) if not torch.equal(other := subject.actions(BATCH, shift), usual)]
    with torch.inference_mode(), subject.calling(subject.prediction):
        frames = subject.look_ahead(model, previous, current, usual)
        apart = any(not torch.equal(subject.look_ahead(model, previous, current, one), frames) for one in others)
    return not others or apart or _reads_one_latent(subject, model)


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
        _trained(subject, model, phase, steps)
        _require_entered_again(subject, model, phase)
    with torch.no_grad(), subject.calling("align(demonstrations)"):
        model.eval().align(subject.demonstrations(each=2, shift=shift))
    return model


def _trained(subject: ModelTrial, model: ForwardModel[Any], phase: Phase, steps: int) -> ForwardModel[Any]:
    """The model after so many more steps, in a phase that it enters."""
    with subject.calling(f"enter({phase.name!r})"):
        model.train().enter(phase)
    optimizer = torch.optim.Adam((one for one in model.parameters() if one.requires_grad), lr=1e-2)
    for step in range(steps):
        with subject.calling(f"progress({step / steps})"):
            model.progress(step / steps)
        losses = losses_of(subject, model, batch_of(subject, phase), seed=step, of=f"after {step} steps of training")
        with subject.calling("losses(batch).total.backward()"):
            torch.autograd.backward(losses.total)
        optimizer.step()
        optimizer.zero_grad()
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
