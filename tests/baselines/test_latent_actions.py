"""LAPO's quantiser, the latent-action VAE, and the table that both are aligned by."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines import lapo
from baselines.clasp import Clasp
from baselines.lapo import Lapo, LapoConfig, VectorQuantizer
from baselines.latent_action_vae import LatentActionVAE
from dmotion_bench.actions import Discrete
from dmotion_bench.learning.model import ModelInputs

CONFIG = LapoConfig(codebooks=2, latents=3, codes=5, length=4, decay=0.75)


def _quantizer() -> VectorQuantizer:
    torch.manual_seed(0)
    quantizer = VectorQuantizer(CONFIG)
    quantizer.codes.normal_()
    quantizer.sums.copy_(quantizer.codes)
    quantizer.counts.fill_(1)
    return quantizer


def test_every_part_becomes_its_nearest_code() -> None:
    quantizer = _quantizer().eval()
    latent = torch.randn(7, CONFIG.action_length)
    quantised, commitment = quantizer(latent)
    parts, result = (x.detach().reshape(7, 2, 3, 4).numpy() for x in (latent, quantised))
    codes = quantizer.codes.numpy()
    error = []
    for row, book, place in np.ndindex(7, 2, 3):
        distances = [((parts[row, book, place] - code) ** 2).sum() for code in codes[book]]
        nearest = codes[book][int(np.argmin(distances))]
        np.testing.assert_allclose(result[row, book, place], nearest, atol=1e-6)
        error.append((parts[row, book, place] - nearest) ** 2)
    np.testing.assert_allclose(commitment.item(), CONFIG.commitment * np.mean(error), rtol=1e-5)


def test_the_chosen_codes_make_up_the_quantised_latent() -> None:
    model = Lapo(CONFIG, ModelInputs(height=32, width=32, actions=Discrete.numbered(4))).eval()
    model.quantizer.load_state_dict(_quantizer().state_dict())
    frames = torch.rand(3, 7, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        codes = model.chosen_codes(*frames)
        quantised, _ = model.quantizer(model.latent_action(*frames))
    assert model.codebook_sizes == (5, 5)
    assert codes.shape == (7, 2, 3)
    parts = [model.quantizer.codes[book][codes[:, book]] for book in (0, 1)]
    torch.testing.assert_close(torch.stack(parts, dim=1).flatten(1), quantised)


def test_gradients_pass_straight_through() -> None:
    latent = torch.randn(7, CONFIG.action_length, requires_grad=True)
    weight = torch.randn(7, CONFIG.action_length)
    quantised, _ = _quantizer().eval()(latent)
    (slope,) = torch.autograd.grad((quantised * weight).sum(), latent)
    torch.testing.assert_close(slope, weight)


def test_codes_follow_the_parts_that_choose_them_in_training_alone() -> None:
    quantizer = _quantizer()
    latent = torch.randn(7, CONFIG.action_length)
    before = quantizer.codes.clone()
    quantizer.eval()(latent)
    assert torch.equal(quantizer.codes, before)
    counts, sums = quantizer.counts.clone(), quantizer.sums.clone()
    parts = latent.reshape(7, 2, 3, 4)
    chosen = quantizer.nearest(parts.permute(1, 0, 2, 3).reshape(2, 21, 4)).reshape(2, 7, 3)
    quantizer.train()(latent)
    for book in range(2):
        for code in range(5):
            mine = parts[:, book][chosen[book] == code]
            count = 0.75 * counts[book, code] + 0.25 * len(mine)
            total = 0.75 * sums[book, code] + 0.25 * mine.sum(0)
            torch.testing.assert_close(quantizer.codes[book, code], total / count)


def test_codes_follow_the_parts_of_all_processes(monkeypatch) -> None:
    """Each process sees a part of the batch; the codes are those of one process that sees all of it."""
    alone, shared = _quantizer().train(), _quantizer().train()
    latents = torch.randn(12, CONFIG.action_length, generator=torch.Generator().manual_seed(3))
    elsewhere = _quantizer().train()
    told: list[torch.Tensor] = []

    monkeypatch.setattr(lapo.dist, "is_initialized", lambda: True)
    monkeypatch.setattr(lapo.dist, "all_reduce", lambda mine: told.append(mine.clone()))
    elsewhere(latents[6:])
    monkeypatch.setattr(lapo.dist, "all_reduce", lambda mine: mine.add_(told.pop(0)))
    shared(latents[:6])
    monkeypatch.setattr(lapo.dist, "is_initialized", lambda: False)
    alone(latents)
    busy = alone.counts >= CONFIG.restart
    torch.testing.assert_close(shared.counts, alone.counts)
    torch.testing.assert_close(shared.codes[busy], alone.codes[busy])


def test_codes_that_nothing_chooses_are_put_where_something_is() -> None:
    torch.manual_seed(0)
    quantizer = VectorQuantizer(CONFIG)
    quantizer.codes[:, 1:] += 100  # far from everything: one code would serve all parts
    latent = torch.randn(7, CONFIG.action_length)
    parts = latent.reshape(7, 2, 3, 4).permute(1, 0, 2, 3).reshape(2, 21, 4)
    assert [len(chosen.unique()) for chosen in quantizer.nearest(parts)] == [1, 1]
    quantizer(latent)
    assert (quantizer.codes[:, 1:, None] == parts[:, None]).all(-1).any(-1).all()
    for _ in range(20):
        quantizer(latent)
    assert min(len(chosen.unique()) for chosen in quantizer.nearest(parts)) >= 4


def test_the_future_reaches_the_prediction_through_the_codes_alone(build, predicted_by_rows, video) -> None:
    model = build(Lapo).eval()
    with torch.no_grad():
        losses = model.losses(video)
        frames = predicted_by_rows(model, video, model.latent_action(video.previous, video.current, video.next))
    torch.testing.assert_close(losses.per_triplet, (frames - video.next).square().mean((1, 2, 3)))


def test_one_demonstration_of_each_action_decides_what_it_does(build, batch, demonstrations) -> None:
    for kind in (Lapo, LatentActionVAE):
        model = build(kind).eval()
        with torch.no_grad():
            model.align(demonstrations)
            frames = [model.predict(batch.previous, batch.current, torch.full((6,), action)) for action in range(4)]
        for one in range(4):
            for other in range(one):
                assert not torch.equal(frames[one], frames[other])


@pytest.mark.parametrize("kind", [Clasp, Lapo, LatentActionVAE])
def test_a_latent_action_predicts_what_a_row_of_the_table_that_holds_it_does(
    build, predicted_by_rows, video, kind
) -> None:
    model = build(kind).eval()
    with torch.no_grad():
        latent = model.latent_action(video.previous, video.current, video.next)
        frames = model.predict_with_latent(video.previous, video.current, latent)
        named = predicted_by_rows(model, video, latent)
    torch.testing.assert_close(frames, named)


def test_draws_are_for_training_alone(build, video) -> None:
    model = build(LatentActionVAE)
    assert model.losses(video).total != model.losses(video).total
    model.eval()
    assert model.losses(video).total == model.losses(video).total


def test_beta_is_paid_in_units_of_images_between_0_and_1(build, video) -> None:
    losses = build(LatentActionVAE, beta=0.25).eval().losses(video)
    in_unit_range = losses.terms["prediction"] / 4
    torch.testing.assert_close(losses.total / 4, in_unit_range + 0.25 * losses.terms["divergence"])


@pytest.mark.slow
def test_both_learn(build, step, video) -> None:
    for kind in (Lapo, LatentActionVAE):
        model = build(kind)
        first = model.losses(video).total.item()
        assert step(model, video, 25) < 0.9 * first
