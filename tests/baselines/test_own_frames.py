"""A model's own frames in its training: which triplets they replace, from where they are made, and what they leave."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from baselines.dmotion import DMotion, DMotionConfig
from baselines.encoder_decoder import EncoderDecoder, EncoderDecoderConfig
from baselines.own_frames import OwnFrames, Step
from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import ModelInputs, TripletBatch

COUNT, EARLIER = 8, 3


def _frames(*shape: int, seed: int) -> Tensor:
    """Whole numbers, whose sums are exact."""
    return torch.randint(-99, 99, shape, generator=torch.Generator().manual_seed(seed)).float()


def _batch(seed: int = 0) -> TripletBatch:
    previous, current, following = (_frames(COUNT, 3, 32, 32, seed=seed + place) / 99 for place in range(3))
    earlier = _frames(COUNT, EARLIER, 3, 32, 32, seed=seed + 9) / 99
    return TripletBatch(previous=previous, current=current, next=following, earlier=earlier)


def _as_it_is(frames: Tensor) -> Tensor:
    return frames


@pytest.mark.parametrize("seed", range(6))
def test_frames_are_made_step_by_step_up_to_x_t_of_the_chosen_triplets(seed: int) -> None:
    """A model that adds the recorded change to its own frame ends at the recorded x_{t-1} and x_t."""
    previous, current, following = (_frames(COUNT, 2, 2, 2, seed=place) for place in range(3))
    batch = TripletBatch(
        previous=previous, current=current, next=following, earlier=_frames(COUNT, EARLIER, 2, 2, 2, seed=9)
    )
    calls = []

    def follow(previous: Tensor, current: Tensor, step: Step) -> Tensor:
        calls.append(step.now)
        return current + (step.after - step.now)

    frames = OwnFrames(share=0.5, steps=EARLIER)
    frames.progress(1.0)
    torch.manual_seed(seed)
    own = frames.of(batch, _as_it_is, follow)
    assert own is not None
    assert len(own.rows) == len(set(own.rows.tolist())) == COUNT // 2
    assert torch.equal(own.current, current[own.rows])
    assert torch.equal(own.previous, previous[own.rows])
    assert 1 <= len(calls) <= EARLIER
    assert torch.equal(calls[-1], previous[own.rows])
    mixed = own.put_into(previous + 100, current + 100)
    left = torch.ones(COUNT, dtype=torch.bool).index_fill(0, own.rows, False)
    for whole, recorded in zip(mixed, (previous, current), strict=True):
        assert torch.equal(whole[own.rows], recorded[own.rows])
        assert torch.equal(whole[left], recorded[left] + 100)


def test_as_many_steps_as_allowed_are_drawn() -> None:
    frames, drawn = OwnFrames(share=1.0, steps=EARLIER), set()
    frames.progress(1.0)
    for seed in range(20):
        torch.manual_seed(seed)
        calls: list[Step] = []
        frames.of(_batch(), _as_it_is, lambda previous, current, step, calls=calls: calls.append(step) or current)
        drawn.add(len(calls))
    assert drawn == {1, 2, 3}


def test_the_share_grows_with_the_training() -> None:
    frames = OwnFrames(share=0.5, steps=EARLIER)
    counts = []
    for done in (0.0, 0.25, 0.5, 1.0):
        frames.progress(done)
        own = frames.of(_batch(), _as_it_is, lambda previous, current, step: current)
        counts.append(0 if own is None else len(own.rows))
    assert counts == [0, 1, 2, 4]
    assert frames.earlier == EARLIER
    assert OwnFrames(share=0.0, steps=EARLIER).earlier == 0


def _model(**settings: float) -> DMotion:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        config = DMotionConfig(jitter=0.0, jitter_end=0.0, **settings)
        return DMotion(config, ModelInputs(height=32, width=32, actions=Discrete.numbered(4)))


@pytest.mark.slow
def test_dmotion_predicts_the_recorded_frame_from_its_own_ones_in_training_alone() -> None:
    batch, model, plain = _batch(), _model(own_frames=0.5, own_steps=EARLIER), _model()
    for one in (model, plain):
        one.progress(0.999)
    torch.manual_seed(3)
    chosen = model.own_frames.of(batch, model.pack, model._followed)
    assert chosen is not None
    assert not chosen.current.requires_grad
    torch.manual_seed(3)
    mixed, recorded = (one.losses(batch).per_triplet for one in (model, plain))
    assert mixed is not None
    assert recorded is not None
    changed = ~torch.isclose(mixed, recorded, rtol=1e-4)
    assert changed.nonzero()[:, 0].tolist() == sorted(chosen.rows.tolist())

    previous, current = (model.unpack(frames).float() for frames in (chosen.previous, chosen.current))
    predicted = model.predict_with_latent(previous, current, model.motion(batch.current, batch.next)[chosen.rows])
    wanted = (predicted - batch.next[chosen.rows]).square().mean((1, 2, 3))
    torch.testing.assert_close(mixed[chosen.rows], wanted, atol=1e-5, rtol=1e-4)
    assert torch.equal(model.eval().losses(batch).total, plain.eval().losses(batch).total)


def _told(batch: TripletBatch) -> TripletBatch:
    """The same batch with actions; before half of its triplets one action too few is known."""
    draw = torch.Generator().manual_seed(4)
    actions = torch.randint(4, (COUNT, EARLIER + 1), generator=draw)
    history = torch.tensor([EARLIER, EARLIER - 1] * (COUNT // 2))
    return replace(batch, action=actions[:, -1], earlier_action=actions[:, :-1], history=history)


@pytest.mark.slow
def test_a_model_that_is_told_actions_replays_those_that_led_to_x_t() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        inputs = ModelInputs(height=32, width=32, actions=Discrete.numbered(4))
        model = EncoderDecoder(EncoderDecoderConfig(own_frames=1.0, own_steps=EARLIER), inputs)
    (phase,) = model.phases()
    assert (phase.needs_actions, phase.earlier) == (True, EARLIER)
    batch = _told(_batch())
    model.progress(1.0)
    for seed in range(20):
        torch.manual_seed(seed)
        own = model.own_frames.of(batch, model.pack, model._followed, needs_actions=True)
        assert own is not None
        if len(own.rows) == COUNT // 2:  # the steps are EARLIER
            break
    assert own.rows.sort().values.tolist() == [0, 2, 4, 6]
    state = model.begin(batch.earlier[own.rows, 0], batch.earlier[own.rows, 1])
    for place in range(EARLIER):
        state = model.advance(state, batch.earlier_action[own.rows, place])
    torch.testing.assert_close((own.previous, own.current), state)

    torch.manual_seed(seed)
    mixed = model.losses(batch).per_triplet
    recorded = model.eval().losses(batch).per_triplet
    predicted = model.frame(model.advance(state, batch.action[own.rows]))
    wanted = (predicted - batch.next[own.rows]).square().mean((1, 2, 3))
    torch.testing.assert_close(mixed[own.rows], wanted, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(mixed[1::2], recorded[1::2])
    alone = replace(batch, history=torch.zeros(COUNT, dtype=torch.long))
    assert torch.equal(model.train().losses(alone).per_triplet, recorded)
    assert not torch.isclose(mixed[::2], recorded[::2], rtol=1e-4).any()


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(InvalidSetting, match=r"own_frames is 1.5 \(from 0 to 1\), own_steps 4 \(1 or more\)"):
        DMotionConfig(own_frames=1.5)
    with pytest.raises(InvalidSetting, match="own_steps 0"):
        DMotionConfig(own_steps=0)
    with pytest.raises(InvalidSetting, match="own_frames is -1"):
        EncoderDecoderConfig(own_frames=-1)
