"""Methods that a model need not have. Where a required one gives the same thing, the two must agree."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dmotion_bench.learning.images import to_pixels
from dmotion_bench.planning.dynamics.model import BranchingModel, FeatureModel, PixelModel
from dmotion_bench.scoring.inverse import InverseModel
from dmotion_bench.scoring.latent_models import CodebookModel, LatentActionModel, codes_fault
from dmotion_bench.scoring.latent_ranking import EmbeddingModel
from dmotion_bench.scoring.latent_samples import LatentBranchingModel
from dmotion_bench.testing.prediction import check_frames
from dmotion_bench.testing.trial import BATCH, ModelTrial, described

PARENTS = (2, 0, 0, 2)  # of the states that a branching gives: some have several, one has none


def check_optional_methods(subject: ModelTrial) -> None:
    """Check the methods that make planning faster, and those that some figures need, of a model that has them."""
    built = subject.build().eval()
    model: object = built
    previous, current = subject.images(BATCH, 1), subject.images(BATCH, 2)
    with torch.inference_mode(), subject.calling("begin(previous, current)"):
        state = built.begin(previous, current)
    if isinstance(model, BranchingModel):
        _check_branch(subject, model, state)
    if isinstance(model, PixelModel):
        with torch.inference_mode(), subject.calling("pixels(state)"):
            pixels, frames = model.pixels(state), to_pixels(built.frame(state))
        subject.require(
            isinstance(pixels, Tensor) and pixels.dtype == torch.uint8 and pixels.shape == frames.shape,
            f"pixels(state) gave {described(pixels)}, not uint8 of the shape {tuple(frames.shape)}",
        )
        apart = int((pixels.int() - frames.int()).abs().max())
        subject.require(apart <= 1, f"pixels(state) differs from the pixels of frame(state) by up to {apart}")
    for name, protocol, axes in (("features", FeatureModel, 2), ("embedding", EmbeddingModel, None)):
        if isinstance(model, protocol):
            with torch.inference_mode(), subject.calling(f"{name}(state)"):
                found = getattr(model, name)(state)
            _check_rows(subject, f"{name}(state)", found, BATCH, axes)
    if isinstance(model, LatentActionModel):
        _check_latent_actions(subject, model, previous, current)
    if isinstance(model, InverseModel):
        method = "infer_action(previous, current, following)"
        with torch.inference_mode(), subject.calling(method):
            named = model.infer_action(previous, current, subject.images(BATCH, 3))
        wanted = subject.actions(BATCH)
        subject.require(
            isinstance(named, Tensor)
            and named.shape == wanted.shape
            and named.is_floating_point() == wanted.is_floating_point(),
            f"{method} gave {described(named)}, not an action for each of {BATCH} rows: {described(wanted)}",
        )


def _check_branch(subject: ModelTrial, model: Any, state: tuple[Tensor, ...]) -> None:
    parents, actions = torch.tensor(PARENTS), subject.actions(len(PARENTS))
    with torch.inference_mode(), subject.calling("branch(state, parent, action)"):
        branched = subject.look(model, model.branch(state, parents, actions))
        expected = subject.look(model, model.advance(tuple(part[parents] for part in state), actions))
    _require_same(subject, "branch(state, parent, action)", branched, expected, "advance of the parents' rows")


def _check_latent_actions(subject: ModelTrial, model: Any, previous: Tensor, current: Tensor) -> None:
    method = "latent_action(previous, current, following)"
    with torch.inference_mode(), subject.calling(method):
        latent = model.latent_action(previous, current, subject.images(BATCH, 3))
    _check_rows(subject, method, latent, BATCH, 2)
    if isinstance(model, CodebookModel):
        method = "chosen_codes(previous, current, following)"
        with torch.inference_mode(), subject.calling(method):
            codes = model.chosen_codes(previous, current, subject.images(BATCH, 3))
        subject.require(not (fault := codes_fault(codes, model.codebook_sizes, BATCH)), f"{method} gave {fault}")
    method = "predict_with_latent(previous, current, latent)"
    with torch.inference_mode(), subject.calling(method):
        frames = model.predict_with_latent(previous, current, latent)
    check_frames(subject, method, frames, current.shape)
    if isinstance(model, LatentBranchingModel):
        parents = torch.tensor(PARENTS)
        with torch.inference_mode(), subject.calling("branch_with_latent(state, parent, latent)"):
            state = model.begin(previous, current)
            branched = model.frame(model.branch_with_latent(state, parents, latent[parents]))
        _require_same(
            subject, "branch_with_latent(state, parent, latent)", branched, frames[parents], "predict_with_latent"
        )


def _check_rows(subject: ModelTrial, method: str, found: Any, count: int, axes: int | None = None) -> None:
    """Check that there is a vector, or something with so many axes, for each row; finite."""
    subject.require(
        isinstance(found, Tensor) and found.ndim > 1 and len(found) == count and (axes is None or found.ndim == axes),
        f"{method} gave {described(found)}, not a vector for each of {count} rows",
    )
    subject.require(bool(found.isfinite().all()), f"{method} gave numbers that are not finite")


def _require_same(subject: ModelTrial, method: str, found: Tensor, expected: Tensor, reference: str) -> None:
    same = found.shape == expected.shape and torch.allclose(found, expected, atol=1e-3)
    subject.require(same, f"{method} leads to other frames than {reference}")
