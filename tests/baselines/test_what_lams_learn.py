"""The grid of *What Do Latent Action Models Actually Learn?*: its losses are known for latents that are known."""

from __future__ import annotations

import json

import pytest
import torch
import torch.nn.functional as F

from baselines.published.what_lams_learn import (
    ACTIONS,
    CELLS,
    FOLLOWS,
    Networks,
    after,
    beside,
    conditions,
    half_width,
    least_errors,
    losses_of,
    main,
    recorded,
    rolled,
    trained,
)


def test_the_square_walks_and_stays_at_the_edges() -> None:
    for cell, action, wanted in (
        (5, 0, 1),
        (5, 1, 9),
        (5, 2, 4),
        (5, 3, 6),
        (5, 4, 5),
        (0, 0, 0),
        (4, 2, 4),
        (11, 3, 11),
    ):
        assert after(torch.tensor([cell]), torch.tensor([action])).item() == wanted


def test_a_correlated_policy_mostly_takes_the_cells_own_action() -> None:
    told = recorded(4000, 1.0, True, torch.Generator().manual_seed(0))
    own = told.before[0, :, :CELLS].argmax(1) % ACTIONS == told.action[0]
    assert own.float().mean().item() == pytest.approx(FOLLOWS + (1 - FOLLOWS) / ACTIONS, abs=0.02)
    free = recorded(4000, 1.0, False, torch.Generator().manual_seed(0))
    assert torch.bincount(free.action[0]).tolist() == pytest.approx([800] * 5, rel=0.1)


def test_the_least_error_without_a_latent_is_that_of_the_mean_of_what_may_follow() -> None:
    data = recorded(20_000, 2.0, False, torch.Generator().manual_seed(0))
    before, following = data.before[0], data.after[0]
    cell = before[:, :CELLS].argmax(1)
    upper = torch.zeros(())
    for place in range(CELLS):
        mine = following[cell == place][:, :CELLS]
        upper += (mine - mine.mean(0)).square().sum()
    noise = following[:, CELLS:]
    found = least_errors(2.0)
    assert found[0] == pytest.approx(float(upper) / len(cell), rel=0.02)
    assert found[1] == pytest.approx(float((noise - noise.mean(0)).square().sum(1).mean()), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("infer", "controllable", "stochastic"),
    [
        (lambda pairs: F.one_hot(pairs.action, ACTIONS).float(), 0.0, 1.0),
        (lambda pairs: pairs.after[:, :, CELLS:], 1.0, 0.0),
        (lambda pairs: pairs.after, 0.0, 0.0),
        (lambda pairs: torch.zeros(1, pairs.action.shape[1], 2), 1.0, 1.0),
    ],
    ids=["the action", "the noise", "everything", "nothing"],
)
def test_losses_say_what_a_latent_holds(infer, controllable, stochastic) -> None:
    torch.manual_seed(0)
    (found,) = losses_of(infer, [1.0], [0], steps=500)
    assert found == pytest.approx((controllable, stochastic), abs=0.12)


def test_rolling_moves_both_parts_round() -> None:
    frame = torch.arange(16.0)[None, None]
    found = rolled(frame, torch.tensor([1]), torch.tensor([3])).reshape(4, 4)
    picture = frame.reshape(4, 4)
    assert torch.equal(found[:3], picture[:3].roll((1, 3), dims=(0, 1)))
    assert torch.equal(found[3], picture[3].roll(3))


@pytest.mark.slow
def test_without_noise_the_latent_holds_the_action_and_with_it_the_noise() -> None:
    torch.manual_seed(0)
    data = beside([recorded(4000, noise, False, torch.Generator().manual_seed(0)) for noise in (0.0, 2.0)])
    models = trained(data, augmented=False, labelled=False, steps=600)
    still, noisy = losses_of(lambda pairs: models.infer(pairs)[0], [0.0, 2.0], [0, 0], steps=400)
    assert still[0] < 0.5
    assert noisy[0] > 0.8
    assert noisy[1] < 0.6


def test_networks_beside_each_other_are_each_their_own() -> None:
    torch.manual_seed(0)
    networks, inputs = Networks(3, 5, 2), torch.randn(3, 7, 5)
    for place in range(3):
        alone = inputs[place]
        for number, layer in enumerate(networks.layers):
            alone = (alone if number == 0 else alone.relu()) @ layer.weight[place] + layer.bias[place]
        torch.testing.assert_close(networks(inputs)[place], alone)


def test_half_of_an_interval_is_students() -> None:
    assert half_width([1.0, 2.0, 3.0]) == pytest.approx(4.303 / 3**0.5, rel=1e-3)
    assert half_width([0.0, 1.0] * 6) == pytest.approx(2.201 * (3 / 11) ** 0.5 / 12**0.5, rel=1e-3)
    assert half_width([1.0]) == float("inf")


@pytest.mark.slow
def test_one_command_prints_a_row_for_each_condition(capsys) -> None:
    main(["--seeds", "1", "--steps", "2", "--probe-steps", "2"])
    printed = capsys.readouterr().out
    assert printed.count("correlated") == printed.count("uniform") == 12
    assert "0.781" in printed
    main(["--seeds", "1", "--steps", "2", "--probe-steps", "2", "--json"])
    assert len(json.loads(capsys.readouterr().out)) == len(conditions()) == 24
    with pytest.raises(SystemExit):
        main(["--seeds", "0"])
