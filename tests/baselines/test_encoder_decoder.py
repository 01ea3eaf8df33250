"""E-D CNN: what it sees, and that it learns."""

from __future__ import annotations

import pytest
import torch

from baselines.encoder_decoder import EncoderDecoder


@pytest.mark.slow
def test_it_learns_what_an_action_does(build, step, batch) -> None:
    model = build(EncoderDecoder)
    first = model.losses(batch).total.item()
    assert step(model, batch, 40) < 0.8 * first
    model.eval()
    with torch.no_grad():
        right = (model.predict(batch.previous, batch.current, batch.action) - batch.next).square().mean()
        wrong = (model.predict(batch.previous, batch.current, (batch.action + 1) % 4) - batch.next).square().mean()
    assert right < wrong


def test_one_frame_or_two(build, batch) -> None:
    both, last = build(EncoderDecoder).eval(), build(EncoderDecoder, second_frame=False).eval()
    with torch.no_grad():
        assert not torch.equal(
            both.predict(batch.previous, batch.current, batch.action),
            both.predict(batch.next, batch.current, batch.action),
        )
        assert torch.equal(
            last.predict(batch.previous, batch.current, batch.action),
            last.predict(batch.next, batch.current, batch.action),
        )


def test_the_loss_is_the_error_of_the_prediction(build, batch) -> None:
    model = build(EncoderDecoder).eval()
    losses = model.losses(batch)
    error = (model.predict(batch.previous, batch.current, batch.action) - batch.next).square().mean((1, 2, 3))
    torch.testing.assert_close(losses.per_triplet, error)
    torch.testing.assert_close(losses.total, error.mean())
