"""What a model predicts: the next frame, and the frames of a rollout, from states that a planner may pick rows of."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from dmotion_bench.testing.trial import BATCH, ModelTrial, described, same

STEPS = 3
FARTHEST = 10.0
"""From zero, where most values of a frame may lie before a training."""


def check_prediction(subject: ModelTrial) -> None:
    """Check ``predict``: repeatable, of each image alone, and for images in which nothing moves.

    Of a model that draws no frames, ``advance`` is checked.
    """
    model = subject.build().eval()
    previous, current, action = subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH)
    before = previous.clone(), current.clone(), action.clone()
    predict = functools.partial(subject.look_ahead, model)
    named, given = subject.predicts
    with torch.inference_mode(), subject.calling(subject.prediction):
        frames = predict(previous, current, action)
    if subject.draws:
        check_frames(subject, subject.prediction, frames, current.shape)
    subject.require(
        all(map(torch.equal, before, (previous, current, action))), f"{named} changes its arguments in place"
    )
    with torch.inference_mode(), subject.calling(subject.prediction):
        again = predict(previous, current, action)
        alone = torch.cat([predict(previous[i : i + 1], current[i : i + 1], action[i : i + 1]) for i in range(BATCH)])
        first = predict(current, current.clone(), action)  # as every control task begins
    subject.require(torch.equal(frames, again), f"{named} differs from one call to the next with the same arguments")
    subject.require(
        torch.allclose(frames, alone, atol=1e-3),
        f"{named} gives a {given} that depends on the other frames of the batch",
    )
    subject.require(
        bool(first.isfinite().all()), f"{named} gave {given}s that are not finite where both images are the same"
    )


def check_rollout(subject: ModelTrial) -> None:
    """Check ``begin``, ``advance``, ``frame`` and ``rollout``, and that drawn frames agree with ``predict``."""
    model = subject.build().eval()
    previous, current = subject.images(BATCH, 1), subject.images(BATCH, 2)
    actions = torch.stack([subject.actions(BATCH, shift) for shift in range(STEPS)], dim=1)
    with torch.inference_mode(), subject.calling("begin, advance, frame"):
        state, frames = model.begin(previous, current), []
        start, copied = state, _copied(subject, state)
        for action in actions.unbind(1):
            kept = _copied(subject, state)
            after = model.advance(state, action)
            subject.require(
                all(map(same, kept, state)),
                "advance changes the state that it is given in place; a planner goes on from one state by several "
                "actions",
            )
            state = after
            frames.append(subject.look(model, state))
    if subject.draws:
        with torch.inference_mode(), subject.calling("rollout(previous, current, actions)"):
            rolled = model.rollout(previous, current, actions)
            predicted = model.predict(previous, current, actions[:, 0])
        check_frames(subject, "rollout(previous, current, actions)", rolled, (BATCH, STEPS, *current.shape[1:]))
        subject.require(
            torch.allclose(rolled, torch.stack(frames, dim=1), atol=1e-4),
            "rollout differs from begin, advance and frame",
        )
        subject.require(
            torch.allclose(rolled[:, 0], predicted, atol=1e-4), "the first frame of rollout differs from predict"
        )
    subject.require(all(map(same, copied, start)), "rollout changes the state of another rollout in place")
    _check_rows(subject, model, start, actions[:, 0], frames[0])


def _copied(subject: ModelTrial, state: Any) -> tuple[Tensor, ...]:
    subject.require(
        isinstance(state, tuple) and all(isinstance(one, Tensor) and len(one) == BATCH for one in state),
        "a state is no tuple of tensors whose first axis is the batch; the planner picks its rows",
    )
    return tuple(one.clone() for one in state)


def _check_rows(subject: ModelTrial, model: Any, state: tuple[Tensor, ...], action: Tensor, frames: Tensor) -> None:
    """Check that a rollout goes on from any rows of an earlier state, as a planner asks for them."""
    rows = torch.arange(BATCH).flip(0)
    with (
        torch.inference_mode(),
        subject.calling("advance(state, action), with rows of an earlier state as a plain tuple,"),
    ):
        again = subject.look(model, model.advance(tuple(part[rows] for part in state), action[rows]))
    subject.require(
        torch.allclose(again, frames[rows], atol=1e-4),
        "advance goes on otherwise from the rows of an earlier state than from that state; whatever a rollout needs "
        "must be in its state, not in the model",
    )


def check_frames(subject: ModelTrial, method: str, frames: Any, shape: tuple[int, ...]) -> None:
    """Check frames that a method gave."""
    subject.require(
        isinstance(frames, Tensor) and frames.shape == shape,
        f"{method} gave {described(frames)}, not frames of the shape {tuple(shape)}",
    )
    subject.require(frames.dtype == torch.float32, f"{method} gave {frames.dtype}, not torch.float32")
    subject.require(bool(frames.isfinite().all()), f"{method} gave frames that are not finite")
    subject.require(
        float(frames.abs().median()) <= FARTHEST,
        f"{method} gave frames whose values reach {float(frames.abs().max()):.4g}; those of frames lie in [-1, 1]",
    )
