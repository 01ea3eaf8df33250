"""Inverse-dynamics relabelling: the inverse model names what it was shown, and E-D CNN learns from names alone."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from walking_dot import walking_dot

from baselines.encoder_decoder import EncoderDecoder
from baselines.vpt import FORWARD, INVERSE, InverseRelabelling
from dmotion_bench.actions import Continuous
from dmotion_bench.learning.model import ModelInputs

MOVES = Continuous(names=("dx", "dy"), low=(-4.0, 0.0), high=(4.0, 2.0), units=("px", "px"))


@pytest.mark.slow
def test_an_inverse_model_of_few_labels_names_a_walk_that_it_has_not_seen(build, step) -> None:
    model = build(InverseRelabelling)
    model.enter(INVERSE)
    torch.manual_seed(0)
    step(model, walking_dot(16, seed=0), 300, rate=1e-3)
    unseen = walking_dot(64, seed=1)
    model.eval()
    with torch.no_grad():
        named = model.infer_action(unseen.previous, unseen.current, unseen.next)
    assert (named == unseen.action).float().mean() > 0.9


def test_the_forward_model_is_e_d_cnn_under_the_named_actions(build, batch, video) -> None:
    model, told = build(InverseRelabelling).eval(), build(EncoderDecoder).eval()
    told.network.load_state_dict(model.network.state_dict())
    model.enter(FORWARD)
    named = model.infer_action(batch.previous, batch.current, batch.next)
    as_labels = dataclasses.replace(batch, action=named)
    torch.testing.assert_close(model.losses(video).total, told.losses(as_labels).total)
    inputs = (batch.previous, batch.current, batch.action)
    torch.testing.assert_close(model.predict(*inputs), told.predict(*inputs))


def test_labels_reach_only_the_inverse_model_and_names_only_the_forward_model(build, batch, video) -> None:
    model = build(InverseRelabelling)
    for phase, seen, part in ((INVERSE, batch, model.inverse), (FORWARD, video, model.network)):
        model.zero_grad()
        model.enter(phase)
        model.losses(seen).total.backward()
        own = {id(one) for one in part.parameters()}
        assert {id(one) for one in model.parameters() if one.grad is not None} == own


@pytest.mark.slow
def test_an_action_that_is_never_shown_is_never_named(build, step) -> None:
    shown = walking_dot(32, seed=0)
    known = shown.action != 3
    fewer = dataclasses.replace(
        shown,
        previous=shown.previous[known],
        current=shown.current[known],
        next=shown.next[known],
        action=shown.action[known],
        episode=None,
    )
    model = build(InverseRelabelling)
    model.enter(INVERSE)
    step(model, fewer, 60, rate=1e-3)
    model.eval()
    unseen = walking_dot(64, seed=1)
    with torch.no_grad():
        named = model.infer_action(unseen.previous, unseen.current, unseen.next)
    assert 3 in unseen.action
    assert 3 not in named


def test_continuous_actions_are_named_in_their_units_and_bounds(video) -> None:
    model = InverseRelabelling(InverseRelabelling.Config(), ModelInputs(height=32, width=32, actions=MOVES))
    scores = torch.tensor([[0.0, 0.0], [0.5, -1.0], [3.0, -9.0]])
    assert model.inverse.named(scores).tolist() == [[0, 1], [2, 0], [4, 0]]
    action = torch.tensor([[0.0, 1.0], [2.0, 0.0], [4.0, 2.0]])
    assert model.inverse.errors(scores, action).tolist() == pytest.approx([0, 0, (2**2 + 10**2) / 2])
