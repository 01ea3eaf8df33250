"""C-SWM: its loss by hand, its graph network's symmetry, its figures against brute force."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from baselines.cswm import CONTRAST, DECODER, ContrastiveConfig, ContrastiveWorldModel
from dmotion_bench.errors import InvalidSetting


def test_the_energy_by_hand(build) -> None:
    model = build(ContrastiveWorldModel, slots=2, features=2, sigma=0.5)
    one = torch.tensor([[[0.0, 0.0], [1.0, 1.0]]])
    other = torch.tensor([[[1.0, 0.0], [1.0, 3.0]]])
    # squared distances 1 and 4 of the two slots; their mean 2.5, times 1 / (2 * 0.25)
    assert model.energy(one, other).tolist() == [5.0]


def test_the_contrastive_loss_by_hand(build, batch, monkeypatch) -> None:
    model = build(ContrastiveWorldModel).eval()
    order = torch.tensor([2, 0, 1, 4, 5, 3])
    monkeypatch.setattr(model, "negatives", lambda given: order)
    losses = model.losses(batch)
    with torch.no_grad():
        now = model.states(batch.previous, batch.current).numpy()
        then = model.states(batch.current, batch.next).numpy()
        change = model.transition(torch.from_numpy(now), batch.action).numpy()
    near, far = [], []
    for row in range(6):
        near.append(np.mean([((now[row] + change[row] - then[row])[k] ** 2).sum() for k in range(6)]) * 2)
        distance = np.mean([((now[row] - now[order[row]])[k] ** 2).sum() for k in range(6)]) * 2
        far.append(max(0.0, 1 - distance))
    np.testing.assert_allclose(losses.total.item(), np.mean(near) + np.mean(far), rtol=1e-5)
    np.testing.assert_allclose(losses.terms["attraction"], np.mean(near), rtol=1e-5)


def test_a_share_of_the_negatives_is_of_the_same_episode(build, batch) -> None:
    torch.manual_seed(0)
    episode = torch.tensor([0, 0, 0, 1, 1, 2])  # the last one is alone
    many = dataclasses.replace(batch, episode=episode)
    for share in (0.0, 0.5, 1.0):
        model = build(ContrastiveWorldModel, near=share)
        drawn = torch.stack([model.negatives(many) for _ in range(400)])
        assert (drawn != torch.arange(6)).all()
        same = (episode[drawn] == episode).float().mean(0)
        torch.testing.assert_close(same, torch.tensor([share] * 5 + [0.0]), atol=0.1, rtol=0)
        assert all(len(drawn[:, row].unique()) > 1 for row in range(3))


def test_without_episodes_the_negatives_are_any_other_state(build, batch) -> None:
    model = build(ContrastiveWorldModel)
    drawn = torch.stack([model.negatives(batch) for _ in range(200)])
    assert all(set(drawn[:, row].tolist()) == {*range(6)} - {row} for row in range(6))


def test_exchanging_slots_exchanges_their_changes(build) -> None:
    transition = build(ContrastiveWorldModel).transition
    state = torch.randn(3, 6, 4, generator=torch.Generator().manual_seed(0))
    action, order = torch.tensor([0, 1, 2]), torch.tensor([3, 1, 5, 0, 2, 4])
    with torch.no_grad():
        torch.testing.assert_close(transition(state, action)[:, order], transition(state[:, order], action))


def test_a_slots_change_depends_on_every_other_slot(build) -> None:
    transition = build(ContrastiveWorldModel).transition
    state = torch.randn(1, 6, 4, generator=torch.Generator().manual_seed(0), requires_grad=True)
    (slope,) = torch.autograd.grad(transition(state, torch.tensor([1]))[0, 2].sum(), state)
    assert (slope[0].abs().sum(1) > 0).all()


@pytest.mark.slow
def test_the_decoder_learns_apart(build, step, batch, video) -> None:
    model = build(ContrastiveWorldModel)
    model.enter(CONTRAST)
    model.losses(batch).total.backward()
    assert all(parameter.grad is None for parameter in model.decoder.parameters())
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    model.zero_grad()
    model.enter(DECODER)
    first = model.losses(video).total.item()
    assert step(model, video, 30) < first
    changed = {
        name.split(".")[0] for name, tensor in model.state_dict().items() if not torch.equal(tensor, before[name])
    }
    assert changed == {"decoder"}


def test_a_state_of_one_frame_knows_no_other(build, batch) -> None:
    others = torch.rand(batch.previous.shape, generator=torch.Generator().manual_seed(1))
    for frames, alike in ((1, True), (2, False)):
        model = build(ContrastiveWorldModel, frames=frames)
        with torch.no_grad():
            state, other = (model.states(previous, batch.current) for previous in (batch.previous, others))
        assert torch.equal(state, other) is alike


def test_a_state_is_made_of_one_or_two_frames() -> None:
    with pytest.raises(InvalidSetting, match="frames is 3; a state is made of 1 or 2"):
        ContrastiveConfig(frames=3)
