"""CLASP: what its latent actions see, and what composing them means."""

from __future__ import annotations

import pytest
import torch

from baselines.clasp import Clasp, ClaspConfig
from baselines.gaussian import Gaussian
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import TripletBatch


def _with(batch: TripletBatch, **frames: torch.Tensor) -> TripletBatch:
    kept = {"previous": batch.previous, "current": batch.current, "next": batch.next}
    return TripletBatch(**{**kept, **frames})


def test_the_composed_step_knows_the_middle_frame_through_the_latent_actions_alone(build, video, monkeypatch) -> None:
    model = build(Clasp).eval()
    other = _with(video, current=video.current.flip(0))
    assert model.losses(video).terms["composition"] != model.losses(other).terms["composition"]
    fixed = Gaussian(torch.ones(6, 16), torch.zeros(6, 16))
    monkeypatch.setattr(model, "compose", lambda earlier, later: fixed)
    assert model.losses(video).terms["composition"] == model.losses(other).terms["composition"]


def test_composition_trains_both_latent_actions_and_needs_both(build) -> None:
    model = build(Clasp)
    earlier, later = (torch.randn(3, 16, requires_grad=True) for _ in range(2))
    model.compose(earlier, later).mean.sum().backward()
    assert earlier.grad.abs().sum() > 0
    assert later.grad.abs().sum() > 0
    assert not torch.equal(model.compose(earlier, later).mean, model.compose(later, earlier).mean)


def test_the_divergences_of_all_three_latent_actions_are_paid(build, video) -> None:
    model = build(Clasp, beta=0.5).eval()
    losses = model.losses(video)
    first, second = (
        model._infer(*_packed(video.previous, video.current)),
        model._infer(*_packed(video.current, video.next)),
    )
    merged = model.compose(first.mean, second.mean)
    paid = first.divergence() + second.divergence() + merged.divergence()
    torch.testing.assert_close(losses.terms["divergence"], paid)
    errors = losses.terms["prediction"] + losses.terms["composition"]
    torch.testing.assert_close(losses.total, errors + 4 * 0.5 * paid)


def test_the_divergences_cost_nothing_at_first_and_validation_pays_them_in_full(build, video) -> None:
    model = build(Clasp, beta=0.5, warm_up=0.2)
    paid = []
    for share in (0.0, 0.1, 0.2, 0.9):
        model.progress(share)
        losses = model.train().losses(video)
        spare = losses.total - losses.terms["prediction"] - losses.terms["composition"]
        paid.append((spare / losses.terms["divergence"]).item())
    assert paid == pytest.approx([0.0, 1.0, 2.0, 2.0], rel=1e-3, abs=1e-3)
    model.progress(0.0)
    losses = model.eval().losses(video)
    errors = losses.terms["prediction"] + losses.terms["composition"]
    torch.testing.assert_close(losses.total, errors + 4 * 0.5 * losses.terms["divergence"])


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_beta_grows_within_the_training(share: float) -> None:
    with pytest.raises(InvalidSetting, match="warm_up must be 0 to 1"):
        ClaspConfig(warm_up=share)


def _packed(*frames: torch.Tensor) -> list[torch.Tensor]:
    from baselines.patches import pack

    return [pack(frame) for frame in frames]


def test_the_stepwise_loss_is_the_error_of_a_prediction_with_the_true_latent_action(
    build, predicted_by_rows, video
) -> None:
    model = build(Clasp).eval()
    with torch.no_grad():
        losses = model.losses(video)
        frames = predicted_by_rows(model, video, model.latent_action(video.previous, video.current, video.next))
    torch.testing.assert_close(losses.per_triplet, (frames - video.next).square().mean((1, 2, 3)))


def test_the_predictor_remembers(build, batch, demonstrations) -> None:
    model = build(Clasp).eval()
    model.align(demonstrations)
    with torch.no_grad():
        frame, hidden, cell = model.begin(batch.previous, batch.current)
        again = model.advance((frame, hidden, cell), batch.action)
        forgetful = model.advance((frame, hidden * 0, cell * 0), batch.action)
    assert not torch.equal(again[0], forgetful[0])


@pytest.mark.slow
def test_it_learns(build, step, video) -> None:
    model = build(Clasp)
    first = model.losses(video).total.item()
    assert step(model, video, 15) < 0.9 * first
