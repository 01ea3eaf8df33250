"""The latent world model: SIGReg against its definition, and a decoder that never reaches the embedding."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines.jepa import DECODER, EMBEDDING, LatentWorldModel, sketched_gaussianity
from dmotion_bench.errors import InvalidSetting


def test_sigreg_is_the_epps_pulley_statistic_along_each_direction() -> None:
    generator = np.random.default_rng(0)
    embeddings, directions = generator.normal(size=(2, 9, 3)) * 1.7 + 0.3, generator.normal(size=(3, 5))
    knots = np.linspace(0, 3, 17)
    statistics = []
    for time in range(2):
        for direction in directions.T:
            along = embeddings[time] @ (direction / np.linalg.norm(direction))
            empirical = np.exp(1j * knots[:, None] * along).mean(1)
            gap = np.abs(empirical - np.exp(-(knots**2) / 2)) ** 2 * np.exp(-(knots**2) / 2)
            statistics.append(9 * 2 * np.trapezoid(gap, knots))  # the integrand is even: twice the half line
    found = sketched_gaussianity(torch.from_numpy(embeddings).float(), torch.from_numpy(directions).float())
    np.testing.assert_allclose(found.item(), np.mean(statistics), rtol=1e-4)


def test_sigreg_tells_a_gaussian_from_a_collapse() -> None:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(16, 64, generator=generator)
    gaussian = torch.randn(1, 512, 16, generator=generator)
    flat = gaussian * (torch.arange(16) < 4)  # twelve of sixteen directions are empty
    good, partly, wholly = (sketched_gaussianity(x, directions) for x in (gaussian, flat, gaussian * 0))
    assert 5 * good < partly < wholly


@pytest.mark.slow
def test_each_phase_changes_its_own_part(build, step, batch, video) -> None:
    model = build(LatentWorldModel, projections=8)
    for phase, given, own in (
        (EMBEDDING, batch, {"encoder", "projector", "predictor"}),
        (DECODER, video, {"decoder"}),
    ):
        before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
        model.train().enter(phase)
        step(model, given, 3)
        changed = {
            name.split(".")[0] for name, tensor in model.state_dict().items() if not torch.equal(tensor, before[name])
        }
        assert changed == own


def test_a_batch_holds_as_many_moments_of_each_episode_as_is_said(build) -> None:
    assert [phase.together for phase in build(LatentWorldModel).phases()] == [16, 1]
    assert [phase.together for phase in build(LatentWorldModel, moments=1).phases()] == [1, 1]
    with pytest.raises(InvalidSetting, match="moments must be 1 or more"):
        build(LatentWorldModel, moments=0)


def test_gradients_reach_the_target_too(build, batch) -> None:
    """There is no stop-gradient: SIGReg alone keeps the embedding from collapsing."""
    model = build(LatentWorldModel, projections=8, regularisation=0.0, dropout=0.0)
    seen = []
    embed = model.embed
    model.embed = lambda image: seen.append(embed(image)) or seen[-1]
    loss = model.losses(batch).total
    (slope,) = torch.autograd.grad(loss, seen[0])
    assert (slope.reshape(3, 6, -1).abs().sum((1, 2)) > 0).all()  # previous, current, next


def test_sigreg_spreads_what_is_too_narrow_and_gathers_what_is_too_wide() -> None:
    generator = torch.Generator().manual_seed(1)
    directions, gaussian = torch.randn(8, 64, generator=generator), torch.randn(1, 512, 8, generator=generator)
    slopes = []
    for size in (0.05, 0.5, 2.0):
        scale = torch.tensor(size, requires_grad=True)
        slopes += torch.autograd.grad(sketched_gaussianity(scale * gaussian, directions), scale)
    assert slopes[0] < 0
    assert slopes[1] < 0
    assert slopes[2] > 0


def test_actions_change_the_prediction_once_it_has_learned(build, step, batch) -> None:
    model = build(LatentWorldModel, projections=8)
    step(model, batch, 5)
    model.eval()
    with torch.no_grad():
        frames = [model.predict(batch.previous, batch.current, torch.full((6,), action)) for action in range(2)]
    assert not torch.equal(*frames)
