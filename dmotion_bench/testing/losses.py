"""What a model's ``losses`` gives in training and in validation."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Final

import torch
from torch import Tensor

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.model import PER_TRIPLET, ForwardModel, Losses, Phase, TripletBatch
from dmotion_bench.specs import Supervision
from dmotion_bench.testing.trial import BATCH, ModelTrial, differing, same
from dmotion_bench.wording import shown

UNTRAINED: Final = "before any training"
NEAR: Final = 1e-5  # relative: how a loss is rounded depends on where in memory the weights lie


def entered(subject: ModelTrial, phase: Phase, *, training: bool) -> ForwardModel[Any]:
    """A new model that has entered a phase."""
    model = subject.build().train(training)
    with subject.calling(f"enter({phase.name!r})"):
        model.enter(phase)
    return model


def batch_of(subject: ModelTrial, phase: Phase) -> TripletBatch:
    """A batch as the training of a phase has it."""
    demonstrated = phase.needs_actions and subject.kind.supervision is Supervision.FEW  # with nothing before it
    earlier = 0 if demonstrated else phase.earlier
    batch = subject.batch(BATCH, actions=phase.needs_actions, labelled=phase.with_labels, earlier=earlier)
    return dataclasses.replace(batch, episode=None) if demonstrated else batch


def losses_of(
    subject: ModelTrial,
    model: ForwardModel[Any],
    batch: TripletBatch,
    *,
    seed: int = 0,
    of: str = UNTRAINED,
) -> Losses:
    """The losses of a batch, each in the form that a training reads.

    Args:
        subject: Whose model it is.
        model, batch: The model and the batch.
        seed: Of the random numbers that it may draw.
        of: What an error says of the batch.
    """
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        try:
            losses = model.losses(batch)
        except ModelContractBroken:
            raise
        except Exception as error:  # of a stranger's model
            kind = type(error).__name__ + ("" if of == UNTRAINED else f" {of}")
            said, why = str(error).rstrip("."), _if_for_lack_of_actions(subject, model, batch)
            raise subject.broken(f"losses(batch) raised {kind}: {said}{why}") from error
    subject.require(isinstance(losses, Losses), f"losses(batch) gave a {type(losses).__name__}, not Losses")
    total, terms = losses.total, losses.terms
    _require_tensor(subject, "total", total)
    subject.require(
        total.shape == (), f"losses(batch).total has the shape {tuple(total.shape)}; it is to be one number"
    )
    subject.require(bool(total.isfinite()), f"losses(batch).total is {float(total.detach())} {of}")
    subject.require(isinstance(terms, Mapping), f"losses(batch).terms is a {type(terms).__name__}, not a dictionary")
    for name, term in terms.items():
        _require_tensor(subject, f"terms[{name!r}]", term)
        subject.require(
            term.shape == () and not term.requires_grad, f"the term {name!r} of its losses is no detached number"
        )
    subject.require(
        "loss" not in terms or same(terms["loss"], total.detach()),
        "one of the terms of its losses is named 'loss', which is the name of losses(batch).total in the curves and in "
        "the choice of the best weights; name it otherwise",
    )
    each = losses.per_triplet
    if each is not None:
        _require_tensor(subject, "per_triplet", each)
        subject.require(
            each.shape == (len(batch.current),),
            f"losses(batch).per_triplet has the shape {tuple(each.shape)}; it is one detached number per triplet",
        )
        subject.require(
            not each.requires_grad, "losses(batch).per_triplet has a gradient; give per_triplet=each.detach()"
        )
        subject.require(
            bool((each.isfinite() & (each >= 0)).all()),
            f"losses(batch).per_triplet is {shown(each.tolist())} for some images; {PER_TRIPLET}",
        )
    return losses


def _if_for_lack_of_actions(subject: ModelTrial, model: ForwardModel[Any], batch: TripletBatch) -> str:
    """What to do about losses that fail only because no action is known."""
    if batch.action is not None:
        return ""
    told = dataclasses.replace(batch, action=subject.actions(len(batch.current)))
    with torch.random.fork_rng():
        try:
            model.losses(told)
        except Exception:  # for another reason, then
            return ""
    if subject.kind.supervision is Supervision.NONE:
        return (
            "; batch.action is None where supervision is Supervision.NONE, and align(demonstrations) is given actions"
        )
    return "; batch.action is None in this phase, and Phase(needs_actions=True) asks for it"


def _require_tensor(subject: ModelTrial, name: str, value: Any) -> None:
    subject.require(isinstance(value, Tensor), f"losses(batch).{name} is a {type(value).__name__}, not a tensor")


def check_losses(subject: ModelTrial, phase: Phase, *, bf16: bool) -> None:
    """Check losses in training: finite, differentiable, repeatable, and independent of unpaid labels.

    Args:
        subject, phase: What is checked.
        bf16: Whether they are computed in bfloat16, too.
    """
    batch = batch_of(subject, phase)
    model = entered(subject, phase, training=True)
    for share in (0.0, 0.5, 0.999):
        with subject.calling(f"progress({share})"):
            model.progress(share)
    before = [tensor.clone() for tensor in (batch.previous, batch.current, batch.next)]
    losses = losses_of(subject, model, batch)
    subject.require(
        all(map(torch.equal, before, (batch.previous, batch.current, batch.next))),
        "losses(batch) changes the batch in place",
    )
    subject.require(losses.total.requires_grad, f"losses(batch).total has no gradient in the phase {phase.name!r}")
    gradients = _gradients(subject, model, losses)
    # to tell a single action from others is learned before any training
    is_learned = subject.has_one_action and (phase.needs_actions or phase.with_labels > 0)
    subject.require(
        is_learned or any(bool(gradient.any()) for gradient in gradients),
        f"no parameter gets a gradient in the phase {phase.name!r}",
    )
    subject.require(
        all(bool(gradient.isfinite().all()) for gradient in gradients),
        f"a gradient is not finite in the phase {phase.name!r}",
    )
    _check_still(subject, phase, batch)
    blind, again = (losses_of(subject, entered(subject, phase, training=True), batch) for _ in range(2))
    subject.require(
        torch.allclose(blind.total, again.total, rtol=NEAR, atol=0),
        f"losses(batch) of two equal models differ after the same torch.manual_seed, in the phase {phase.name!r}; a "
        "run must repeat, so random numbers must come from torch's own generator: torch.rand, not numpy or random",
    )
    if subject.kind.supervision is Supervision.NONE:
        told = subject.batch(BATCH, actions=True, earlier=phase.earlier)
        seeing = losses_of(subject, entered(subject, phase, training=True), told)
        subject.require(
            torch.equal(blind.total, seeing.total), "its supervision is NONE but losses(batch) depends on batch.action"
        )
    if not bf16:
        return
    halved = entered(subject, phase, training=True)
    with torch.autocast("cpu", torch.bfloat16):
        _gradients(subject, halved, losses_of(subject, halved, batch, of="in bfloat16, under torch.autocast"))


def _check_still(subject: ModelTrial, phase: Phase, batch: TripletBatch) -> None:
    """Check the losses of triplets in which nothing moves: every recording has some, and one spoils all weights."""
    still = dataclasses.replace(batch, previous=batch.current.clone(), next=batch.current.clone())
    model = entered(subject, phase, training=True)
    where = f"in the phase {phase.name!r} for triplets in which nothing moves, where the three frames are the same"
    losses = losses_of(subject, model, still, of=where)
    if not losses.total.requires_grad:
        return
    subject.require(
        all(bool(gradient.isfinite().all()) for gradient in _gradients(subject, model, losses)),
        f"a gradient is not finite {where}; at zero, the gradient of a square root or of a division by a norm is not",
    )


def _gradients(subject: ModelTrial, model: ForwardModel[Any], losses: Losses) -> list[Tensor]:
    with subject.calling("losses(batch).total.backward()"):
        losses.total.backward()  # type: ignore[no-untyped-call]
    return [parameter.grad for parameter in model.parameters() if parameter.grad is not None]


def check_validation(subject: ModelTrial, phase: Phase) -> None:
    """Check losses in evaluation: repeatable, for any batch, and without side effects."""
    model = entered(subject, phase, training=False).eval()
    state = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    batch = subject.batch(BATCH, actions=phase.needs_actions)
    with torch.no_grad():
        first, second = (losses_of(subject, model, batch, of="in evaluation mode").total for _ in range(2))
        subject.require(torch.equal(first, second), "losses(batch) in evaluation mode differ from one call to the next")
        changed = differing(state, model.state_dict())
        subject.require(not changed, f"losses(batch) changes {changed} in evaluation mode")
        losses_of(subject, model, subject.batch(1, actions=phase.needs_actions))
