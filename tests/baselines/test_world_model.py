"""World models: two phases that leave each other alone, and a divergence that is the divergence."""

from __future__ import annotations

import pytest
import torch

from baselines.gaussian import Gaussian
from baselines.world_model import AUTOENCODER, TRANSITION, AutoencoderWorldModel, VariationalWorldModel


def _after(model, step, batch, phase) -> set[str]:
    """The parts that a phase's steps change."""
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    model.enter(phase)
    step(model, batch, 3)
    return {name.split(".")[0] for name, tensor in model.state_dict().items() if not torch.equal(tensor, before[name])}


def test_each_phase_changes_its_own_part(build, step, batch, video) -> None:
    for kind in (AutoencoderWorldModel, VariationalWorldModel):
        model = build(kind)
        assert _after(model, step, video, AUTOENCODER) == {"encoder", "decoder"}
        assert _after(model, step, batch, TRANSITION) == {"transition"}


@pytest.mark.slow
def test_both_phases_learn(build, step, batch, video) -> None:
    model = build(AutoencoderWorldModel)
    for phase, given in ((AUTOENCODER, video), (TRANSITION, batch)):
        model.enter(phase)
        first = model.losses(given).total.item()
        assert step(model, given, 40) < 0.7 * first


def test_the_prediction_decodes_the_code_that_the_transition_gives(build, batch) -> None:
    model = build(AutoencoderWorldModel).eval()
    with torch.no_grad():
        state = model.begin(batch.previous, batch.current)
        torch.testing.assert_close(model.frame(state), model.frame(model.begin(batch.next, batch.current)))
        later = model.advance(state, batch.action)
        assert torch.equal(later[0], state[1])
        model.transition[-1].weight.zero_()  # nothing changes any more
        model.transition[-1].bias.zero_()
        torch.testing.assert_close(model.predict(batch.previous, batch.current, batch.action), model.frame(state))


def test_the_divergence_is_that_of_torchs_distributions() -> None:
    generator = torch.Generator().manual_seed(0)
    code = Gaussian.of(torch.randn(5, 14, generator=generator))
    inferred = torch.distributions.Normal(code.mean, (0.5 * code.log_variance).exp())
    unit = torch.distributions.Normal(torch.zeros(5, 7), torch.ones(5, 7))
    expected = torch.distributions.kl_divergence(inferred, unit).sum(1).mean()
    torch.testing.assert_close(code.divergence(), expected)


def test_draws_have_the_moments_they_are_asked_for() -> None:
    torch.manual_seed(0)
    code = Gaussian(torch.full((1, 20_000), 1.5), torch.full((1, 20_000), -1.0))
    drawn = code.sample()
    assert abs(drawn.mean().item() - 1.5) < 0.02
    assert abs(drawn.std().item() - torch.tensor(-0.5).exp().item()) < 0.02


@pytest.mark.slow
def test_a_heavier_divergence_leaves_less_in_the_code(build, step, video) -> None:
    divergences = []
    for beta in (0.0, 1000.0):
        model = build(VariationalWorldModel, beta=beta)
        step(model, video, 25)
        divergences.append(model.losses(video).terms["divergence"])
    assert divergences[1] < 0.2 * divergences[0]
