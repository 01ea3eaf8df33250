"""DMotion: the published numbers, and the structure that the method rests on."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from baselines import dmotion_paper
from baselines.dmotion import DMotion, DMotionConfig, DMotionNoSTN
from baselines.motion import theta_of_shift
from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import Demonstrations, ModelInputs, TripletBatch

INPUTS = ModelInputs(height=128, width=128, actions=Discrete.numbered(4))
SMALL = ModelInputs(height=32, width=32, actions=Discrete.numbered(4))


def _images(count: int, size: int = 32, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def _model(inputs: ModelInputs = SMALL, **settings) -> DMotion:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return DMotion(DMotionConfig(**settings), inputs)


def test_the_papers_architecture_has_the_papers_size() -> None:
    model = DMotion(DMotionConfig(arch="paper", transform="affine"), INPUTS)
    assert sum(parameter.numel() for parameter in model.parameters()) == 2_684_142


@pytest.mark.slow
def test_the_papers_architecture_has_the_papers_shapes() -> None:
    maps = dmotion_paper.ImageEncoder(8)
    shapes = []
    for layer in maps.layers:
        layer.register_forward_hook(lambda _m, _i, output: shapes.append(tuple(output.shape[1:])))
    images = _images(2, 128)
    assert maps(images).shape == (2, 8, 64, 64)
    assert shapes == [
        (3, 256, 256),
        (32, 128, 128),
        (32, 128, 128),
        (64, 64, 64),
        (64, 64, 64),
        (64, 64, 64),
        (32, 64, 64),
        (8, 64, 64),
    ]
    motion = dmotion_paper.MotionEncoder(8, torch.tensor([1.0, 0, 0, 0, 1, 0]))
    assert motion.convolutions(torch.cat([images, images], 1)).shape == (2, 8, 4, 4)
    assert motion(images, images).shape == (2, 8, 6)
    assert dmotion_paper.Decoder(8)(torch.zeros(2, 8, 64, 64)).shape == (2, 3, 128, 128)
    assert dmotion_paper.InteractionLearner()([images, images], torch.zeros(2, 1, 64, 64)).shape == (
        2,
        3,
        128,
        128,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("side", "halvings", "features"), [(128, 5, 16), (64, 4, 16), (32, 3, 16), (96, 4, 36)])
def test_the_papers_networks_take_frames_of_other_sizes_as_the_published_code_does(
    side: int, halvings: int, features: int
) -> None:
    """There the last stride is 1 at 64 pixels, so that motions are read from maps of 4 x 4 as at 128."""
    model = _model(ModelInputs(height=side, width=side, actions=Discrete.numbered(4)), arch="paper").eval()
    strides = [layer.stride for layer in model.motion_encoder.modules() if isinstance(layer, torch.nn.Conv2d)]
    assert strides == [(2, 2)] * halvings + [(1, 1)] * (7 - halvings)
    assert model.motion_encoder.heads[0][0].in_features == features
    frames = _images(2, side)
    assert model.feature_maps(frames).shape == (2, 8, 64, 64)
    assert model.predict(frames, frames, torch.tensor([0, 3])).shape == frames.shape


def test_before_training_the_papers_motions_are_the_identity() -> None:
    model = DMotion(DMotionConfig(arch="paper", transform="affine"), INPUTS).eval()
    motion = model.motion(_images(2, 128), _images(2, 128, 1))
    torch.testing.assert_close(motion, torch.tensor([[1.0, 0, 0, 0, 1, 0]] * 2))


@pytest.mark.slow
def test_before_training_the_papers_kernels_hardly_move_anything() -> None:
    """One in the middle, zeros elsewhere, moves nothing."""
    torch.manual_seed(0)
    model = DMotionNoSTN(DMotionNoSTN.configure("paper"), INPUTS).eval()
    with torch.no_grad():
        motion = model.motion(_images(2, 128), _images(2, 128, 1))
    identity = model.transform.identity()
    assert torch.linalg.vector_norm(motion - identity, dim=-1).max() < 0.2 * torch.linalg.vector_norm(identity)


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["compact", "paper"])
def test_the_next_frame_reaches_the_prediction_through_the_agents_motion_alone(arch: str) -> None:
    model = _model(INPUTS if arch == "paper" else SMALL, arch=arch, jitter=0.0, jitter_end=0.0).eval()
    size = 128 if arch == "paper" else 32
    previous, current, following = (_images(2, size, seed) for seed in range(3))
    seen = []
    model.interaction_learner.register_forward_hook(lambda _m, _i, output: seen.append(output))
    model.losses(TripletBatch(previous=previous, current=current, next=following))
    torch.testing.assert_close(
        model.unpack(seen[0]).float(),
        model.predict_with_latent(previous, current, model.motion(current, following)),
        atol=1e-5,
        rtol=1e-4,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("arch", "warp"), [("compact", False), ("compact", True), ("paper", False)])
def test_every_parameter_learns(arch: str, warp: bool) -> None:
    model = _model(INPUTS if arch == "paper" else SMALL, arch=arch, warp=warp)
    size = 128 if arch == "paper" else 32
    if arch == "paper":
        for head in model.motion_encoder.heads:
            torch.nn.init.normal_(head[-1].weight, std=0.1)  # zero at first: nothing reaches the layers below
    batch = TripletBatch(previous=_images(2, size), current=_images(2, size, 1), next=_images(2, size, 2))
    model.losses(batch).total.backward()
    idle = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.abs().sum()]
    assert idle == []


def test_the_table_holds_the_mean_motion_of_each_actions_demonstrations() -> None:
    model = _model().eval()
    current, following = _images(6), _images(6, seed=1)
    actions = torch.tensor([0, 1, 2, 3, 0, 0])
    model.align(Demonstrations(previous=current, current=current, next=following, action=actions))
    motion = model.motion(current, following)
    torch.testing.assert_close(model.table.rows[0], motion[[0, 4, 5]].mean(0))
    torch.testing.assert_close(model.table.rows[3], motion[3])
    torch.testing.assert_close(
        model.predict(current, current, actions), model.predict_with_latent(current, current, model.table(actions))
    )


def test_without_the_second_frame_the_past_does_not_matter() -> None:
    model = _model(second_frame=False).eval()
    current, action = _images(2), torch.tensor([0, 1])
    torch.testing.assert_close(
        model.predict(_images(2, seed=1), current, action), model.predict(_images(2, seed=2), current, action)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{"transform": "affine"}, {"transform": "cross_convolution", "kernel": 5}, {"warp": True}]
)
@pytest.mark.parametrize("agent_entries", [1, 3])
def test_the_ablations_learn_and_predict(settings: dict, agent_entries: int) -> None:
    model = _model(agent_entries=agent_entries, **settings)
    batch = TripletBatch(previous=_images(2), current=_images(2, seed=1), next=_images(2, seed=2))
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    first = model.losses(batch).total.item()
    for _ in range(15):
        optimizer.zero_grad()
        model.losses(batch).total.backward()
        optimizer.step()
    assert model.losses(batch).total.item() < 0.9 * first
    assert model.eval().rollout(batch.previous, batch.current, torch.zeros(2, 3, dtype=torch.long)).shape == (
        2,
        3,
        3,
        32,
        32,
    )


def test_noise_is_for_training_alone_and_ends_where_it_is_told() -> None:
    model = _model(jitter=3.0, jitter_end=0.25, blur=5.0, anneal=0.5)
    model.progress(0.25)
    assert (model.jitter, model.blur) == (pytest.approx(2.3125), pytest.approx(3.0))
    model.progress(0.9)
    assert (model.jitter, model.blur) == (pytest.approx(0.525), 1.0)
    batch = TripletBatch(previous=_images(2), current=_images(2, seed=1), next=_images(2, seed=2))
    model.eval()
    assert model.losses(batch).total == model.losses(batch).total
    model.train()
    assert model.losses(batch).total != model.losses(batch).total
    with pytest.raises(InvalidSetting, match="jitter and jitter_end 0 or more"):
        DMotionConfig(jitter_end=-1.0)  # the noise would vanish in between and come back
    quiet = _model(jitter=0.0)
    quiet.progress(0.9)
    assert quiet.jitter == 0


@pytest.mark.parametrize("height", [40, 33])
def test_sizes_that_it_cannot_take_are_said(height: int) -> None:
    with pytest.raises(InvalidSetting, match="multiple of 16"):
        DMotion(DMotionConfig(), ModelInputs(height=height, width=height, actions=Discrete.numbered(4)))


@pytest.mark.parametrize("setting", [{"warp": True}, {"gate_floor": 0.01}, {"width": 2}])
def test_the_papers_interaction_learner_has_no_such_choice(setting: dict[str, Any]) -> None:
    (name,) = setting
    with pytest.raises(InvalidSetting, match=f"{name} is for arch=compact"):
        DMotionConfig(arch="paper", **setting)


def test_going_back_undoes_going_there() -> None:
    model = _model().eval()
    there, back = _images(3), _images(3, seed=1)
    torch.testing.assert_close(model.motion(there, back), -model.motion(back, there))
    torch.testing.assert_close(model.motion(there, there), torch.zeros(3, 2))


def test_no_motion_of_the_compact_networks_is_longer_than_their_page_says() -> None:
    model = _model().eval()
    with torch.no_grad():
        model.motion_encoder.motion.weight.mul_(1e6)
        longest = model.pixel_shift(model.motion(_images(3), _images(3, seed=1))).abs().max()
    assert 0.25 * SMALL.width < longest <= 0.3 * SMALL.width


def test_the_extractor_cannot_know_where_in_the_picture_it_looks() -> None:
    """Or phi^0 becomes a function of the agent's place, and one demonstration of an action says nothing of others."""
    model = _model(INPUTS).eval()
    current, following = _images(2, 128), _images(2, 128, 1)
    moved = [image.roll((48, 16), dims=(-2, -1)) for image in (current, following)]
    torch.testing.assert_close(model.motion(*moved), model.motion(current, following), atol=1e-5, rtol=1e-4)
    maps = model.feature_maps(current).roll((24, 8), dims=(-2, -1))
    torch.testing.assert_close(model.feature_maps(moved[0]), maps, atol=1e-5, rtol=1e-4)


JOINT = Discrete.joint(("up", "down"), ("left", "right"))
TWO = ModelInputs(height=32, width=32, actions=JOINT)


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["compact", "paper"])
def test_of_two_agents_each_is_seen_through_its_own_map_and_motion(arch: str) -> None:
    """The prediction depends on both maps' motions and, of the next frame, on nothing else."""
    model = _model(TWO, arch=arch, agents=2).eval()
    previous, current, following = (_images(2, seed=seed) for seed in (1, 2, 3))
    with torch.no_grad():
        for parameter in model.motion_encoder.parameters():  # the paper's networks begin with no motion at all
            parameter.add_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(4)) * 0.1)
        latent = model.latent_action(previous, current, following)
        assert latent.shape == (2, 4)
        motions = model.agent_motions(latent)
        torch.testing.assert_close(motions, model.motion_encoder(model.pack(current), model.pack(following))[:, :2])
        base = model.predict_with_latent(previous, current, latent)
        for agent in (0, 1):
            other = motions.clone()
            other[:, agent] += 0.4
            assert not torch.equal(model.predict_with_latent(previous, current, other.flatten(1)), base)
        maps = model.agent_maps(current)
        torch.testing.assert_close(maps, model.feature_maps(current)[:, :2].abs())
        torch.testing.assert_close(model.agent_map(current), maps[:, 0])


def test_after_alignment_everything_is_in_the_order_of_the_agents() -> None:
    model = _model(TWO, agents=2).eval()
    previous, current, following = (_images(8, seed=seed) for seed in (1, 2, 3))
    with torch.no_grad():
        before = model.latent_action(previous, current, following)
        maps = model.agent_maps(current)
        predicted = model.predict_with_latent(previous, current, before)
        first, second = model.agent_motions(before).unbind(1)
        # actions that tell the second map's motion by the first agent's part: the maps are swapped
        action = 2 * (second[:, 0] > second[:, 0].median()).long() + (first[:, 0] > first[:, 0].median()).long()
        model.align(Demonstrations(previous=previous, current=current, next=following, action=action))
        assert model.table.order.tolist() == [1, 0]
        after = model.latent_action(previous, current, following)
        torch.testing.assert_close(model.agent_motions(after), torch.stack([second, first], 1))
        torch.testing.assert_close(model.agent_maps(current), maps.flip(1))
        torch.testing.assert_close(model.predict_with_latent(previous, current, after), predicted)
        told = torch.stack(
            [table(part) for table, part in zip(model.table.tables, (action // 2, action % 2), strict=True)], 1
        )
        torch.testing.assert_close(
            model.predict(previous, current, action), model.predict_with_latent(previous, current, told.flatten(1))
        )
        kept = _model(TWO, agents=2).eval()
        kept.load_state_dict(model.state_dict())
        assert torch.equal(kept.predict(previous, current, action), model.predict(previous, current, action))


def test_agents_that_cannot_be_are_said() -> None:
    for agents in (0, 5):
        with pytest.raises(InvalidSetting, match=f"agents is {agents}; it can be 1 to 4, with 8 maps"):
            DMotionConfig(agents=agents)
    with pytest.raises(InvalidSetting, match="agents is 2; it can be 1 to 1, with 1 maps"):
        DMotionConfig(agents=2, maps=1)
    with pytest.raises(InvalidSetting, match=r"2 agents, and the actions of its data set are of 1 agent.*agents=1"):
        _model(SMALL, agents=2)


def test_a_setting_of_one_agent_changes_no_weight() -> None:
    plain, named = _model().state_dict(), _model(agents=1).state_dict()
    assert list(plain) == list(named)
    assert "table" in plain
    assert all(torch.equal(plain[name], named[name]) for name in plain)


def _moving(x: int, y: int) -> TripletBatch:
    """A white square on black that moves by (x, y) [px]."""
    frames = torch.full((3, 1, 3, 32, 32), -1.0)
    for moment, frame in enumerate(frames):
        frame[..., 12 + y * (moment == 2) :, 12 + x * (moment == 2) :][..., :6, :6] = 1.0
    return TripletBatch(previous=frames[0], current=frames[1], next=frames[2])


def test_phi_0_is_guided_to_the_shift_that_explains_what_changes() -> None:
    """The gradient of what guides it pulls it there, and nothing is left to pull when it is there."""
    model, batch = _model(guide=1.0), _moving(5, -3)
    wanted = theta_of_shift(torch.tensor([[[2.5, -1.5]]]), 16)  # of the map, whose pixels are two of the frame
    there = torch.cat([wanted, torch.zeros(1, 7, 2)], dim=1)
    assert model._guidance(batch, there).item() < 0.005
    motion = torch.zeros(1, 8, 2, requires_grad=True)
    model._guidance(batch, motion).backward()
    assert torch.equal(motion.grad[:, 1:], torch.zeros(1, 7, 2))
    assert torch.equal(motion.grad[0, 0].sign(), -wanted[0, 0].sign())
    still = TripletBatch(previous=batch.current, current=batch.current, next=batch.current)
    assert model._guidance(still, motion).item() == 0


@pytest.mark.parametrize("arch", ["compact", "paper"])
def test_a_shift_of_the_frame_is_that_of_the_map_times_the_frames_pixels_in_one_of_the_map(arch: str) -> None:
    """A map of 64 pixels spans 63 steps between its outermost centres, the frame 127: not one is twice the other."""
    model = _model(INPUTS, arch=arch, blur=1.0, jitter=0.0, jitter_end=0.0)
    theta = theta_of_shift(torch.tensor([[12.8, -3.0]]), model.feature_maps(_images(1, 128)).shape[-1])
    torch.testing.assert_close(model.pixel_shift(theta), torch.tensor([[25.6, -6.0]]))


def test_the_guide_lets_go_and_is_for_training_alone() -> None:
    batch = _moving(5, -3)
    plain, guided = _model(jitter=0.0, jitter_end=0.0), _model(guide=1.0, guided=0.5, jitter=0.0, jitter_end=0.0)
    guided.load_state_dict(plain.state_dict())
    assert "guidance" in guided.losses(batch).terms
    assert guided.losses(batch).total > plain.losses(batch).total
    for share in (0.5, 0.9):
        guided.progress(share)
        plain.progress(share)
        assert torch.equal(guided.losses(batch).total, plain.losses(batch).total)
    guided.progress(0.0)
    plain.progress(0.0)
    assert torch.equal(guided.eval().losses(batch).total, plain.eval().losses(batch).total)


def test_who_is_guided() -> None:
    assert DMotion.configure("compact").guide == 1
    assert DMotionConfig().guide == DMotion.configure("paper").guide == DMotionNoSTN.configure("compact").guide == 0
    for model in (
        _model(TWO, guide=1.0, agents=2),
        _model(guide=1.0, transform="affine"),
        _model(guide=1.0, transform="cross_convolution", kernel=3),
    ):
        assert "guidance" not in model.losses(_moving(2, 2)).terms
    with pytest.raises(InvalidSetting, match="guide must be 0 or more"):
        DMotionConfig(guide=-1.0)


@pytest.mark.parametrize(
    "settings",
    [
        {"kernel": 5},
        {"kernel": 5, "transform": "affine"},
        {"blur": 4.0, "transform": "affine"},
        {"jitter": 2.0, "transform": "cross_convolution"},
        {"guide": 0.5, "transform": "affine"},
        {"anneal": 0.5, "transform": "cross_convolution"},
    ],
)
def test_a_setting_that_would_do_nothing_is_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match=f"{next(iter(settings))} is for transform="):
        DMotionConfig(**settings)
    for arch in DMotion.architectures:
        for transform in ("affine", "cross_convolution"):
            dataclasses.replace(DMotion.configure(arch), transform=transform)
