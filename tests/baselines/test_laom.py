"""LAOM: what its losses compare, whom the target follows, and what a few labels teach the latent action."""

from __future__ import annotations

import dataclasses

import pytest
import torch
import torch.nn.functional as F
from walking_dot import walking_dot

from baselines.laom import DECODER, Changes, Laom, LaomWithLabels
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import Demonstrations

SMALL = {"length": 16, "embedding": 32, "hidden": 64}


def _shown(count: int, seed: int) -> Demonstrations:
    dots = walking_dot(count, seed)
    return Demonstrations(previous=dots.previous, current=dots.current, next=dots.next, action=dots.action)


def test_the_loss_is_the_distance_to_the_targets_embedding_of_the_next_frame(build, video) -> None:
    model = build(Laom, **SMALL).eval()
    with torch.no_grad():
        loss = model.losses(video).total
        predicted = model._advance(
            model.embed(video.current), model.latent_action(video.previous, video.current, video.next)
        )
    wanted = model.embed(video.next)  # the target's too, before the first step; changes count as they are
    torch.testing.assert_close(loss, F.mse_loss(predicted, wanted), rtol=1e-4, atol=0)


def test_a_predicted_change_is_undone_by_the_statistics_in_which_it_was_learned(build, video) -> None:
    """They are those of one step; what the inverse model is given is of one step or two."""
    model = build(Laom, **SMALL).eval()
    model.changes.statistics.running_var.fill_(9)
    model.target_changes.statistics.running_var.fill_(4)
    model.target_changes.statistics.running_mean.fill_(0.5)
    with torch.no_grad():
        loss = model.losses(video).total
        latent = model.latent_action(video.previous, video.current, video.next)
        predicted = model._advance(model.embed(video.current), latent)
    error = F.mse_loss(predicted, model.embed(video.next))
    torch.testing.assert_close(4 * loss, error, rtol=1e-4, atol=0)


def test_a_change_counts_in_units_of_its_own_spread_and_what_stands_still_for_nothing() -> None:
    torch.manual_seed(0)
    change = torch.randn(64, 4) * torch.tensor([1.0, 0.03, 30.0, 0.0]) + 2
    changes = Changes(4)
    for _ in range(200):
        standard = changes(change)
    torch.testing.assert_close(standard.std(0, correction=0), torch.tensor([1.0, 1, 1, 0]), rtol=0.01, atol=1e-6)
    kept = changes.statistics.running_var.clone()
    for used in (changes(change[:1]), changes(change[:8], own=False), changes.eval()(change[:8])):
        torch.testing.assert_close(used, standard[: len(used)], rtol=0.02, atol=1e-3)
    assert torch.equal(changes.statistics.running_var, kept)
    torch.testing.assert_close(changes.undone(changes(change)), change)


def test_each_labelled_transition_is_rolled_by_a_shift_of_its_own_and_its_frames_alike(build) -> None:
    model = build(LaomWithLabels, label_shift=3, **SMALL).train()
    image = torch.arange(32.0).expand(16, 3, 32, 32)
    first, second = model._rolled_each(image, image + 100)
    torch.testing.assert_close(second, first + 100)
    assert len({one[0, 0, 0].item() for one in first}) > 3
    assert torch.equal(model.eval()._rolled_each(image)[0], image)


def test_the_inverse_model_looks_one_step_or_two_ahead_and_the_forward_model_always_one(build) -> None:
    model = build(Laom, **SMALL).train()
    torch.manual_seed(0)
    start, ahead = model._drawn(200, torch.device("cpu"))
    assert set(zip(start.tolist(), ahead.tolist(), strict=True)) == {(1, 1), (0, 2)}
    assert 60 < int((ahead == 2).sum()) < 140
    start, ahead = build(Laom, ahead=1, **SMALL)._drawn(9, torch.device("cpu"))
    assert (start == 1).all()
    assert (ahead == 1).all()


def test_the_target_follows_the_encoder_as_a_running_mean_and_is_not_trained(build, video) -> None:
    model = build(Laom, target_rate=0.25, **SMALL)
    slow, fast = next(model.target.parameters()), next(model.encoder.parameters())
    before = slow.clone()
    with torch.no_grad():
        fast += 1
    model.progress(0.0)
    torch.testing.assert_close(slow, before + 0.25)
    model.losses(video).total.backward()
    assert fast.grad is not None
    assert slow.grad is None
    model.enter(DECODER)
    model.progress(0.5)
    torch.testing.assert_close(slow, before + 0.25)
    assert {one.requires_grad for one in model.target.parameters()} == {False}


def test_labels_are_one_weighted_term_of_the_loss(build, video) -> None:
    shown = _shown(8, 0)
    model = build(LaomWithLabels, label_weight=0.5, **SMALL).eval()
    with torch.no_grad():
        alone = model.losses(video)
        both = model.losses(dataclasses.replace(video, labelled=shown))
        read = model.true_action(model.latent_action(shown.previous, shown.current, shown.next))
    torch.testing.assert_close(both.total, alone.total + 0.5 * F.cross_entropy(read, shown.action))
    assert "labels" not in alone.terms


@pytest.mark.slow
def test_a_few_labels_put_the_action_into_the_latent(build, step) -> None:
    video, unseen = walking_dot(32, seed=1), walking_dot(64, seed=2)
    model = build(LaomWithLabels, label_weight=1.0, label_shift=4, **SMALL)
    torch.manual_seed(0)
    step(model, dataclasses.replace(video, action=None, labelled=_shown(16, 0)), 200, rate=1e-3)
    model.eval()
    with torch.no_grad():
        read = model.true_action(model.latent_action(unseen.previous, unseen.current, unseen.next))
    assert (read.argmax(1) == unseen.action).float().mean() > 0.9  # by chance 0.25


def test_a_latent_action_predicts_what_a_row_of_the_table_that_holds_it_does(build, predicted_by_rows, video) -> None:
    model = build(Laom, **SMALL).eval()
    with torch.no_grad():
        latent = model.latent_action(video.previous, video.current, video.next)
        frames = model.predict_with_latent(video.previous, video.current, latent)
        named = predicted_by_rows(model, video, latent)
    torch.testing.assert_close(frames, named)


def test_weights_of_labels_are_for_the_model_that_is_given_some(build) -> None:
    build(LaomWithLabels, label_weight=0.1, **SMALL)
    with pytest.raises(InvalidSetting, match="are for laom-labels"):
        build(Laom, label_weight=0.1, **SMALL)
