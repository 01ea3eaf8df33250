"""Models of two frames: what they carry packed and compute once changes no bit of what they predict."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.planning.dynamics.model import BranchingModel, PixelModel
from dmotion_bench.registry import model_class

MODELS = ("dmotion", "dmotion-no-stn", "ed-cnn", "lam-vae", "lapo")
STATES, SIDE, FOUR = 3, 32, Discrete.numbered(4)
PARENT = torch.tensor([0, 0, 0, 1, 2, 2, 2, 2])
ACTION = torch.tensor([0, 1, 3, 2, 0, 1, 2, 3])


def built(name: str, actions: Discrete = FOUR, **changes: object) -> Any:
    kind = model_class(name)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        config = kind.configure("compact") if not changes else type(kind.configure("compact"))(**changes)
        inputs = ModelInputs(height=SIDE, width=SIDE, actions=actions)
        return kind(config, inputs).laid_out(channels_last=True).eval()


def images(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(STATES, 3, SIDE, SIDE, generator=generator) * 2 - 1


@pytest.mark.parametrize("bf16", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_actions_at_one_state_are_predicted_as_each_alone(name: str, bf16: bool) -> None:
    model = built(name)
    assert isinstance(model, BranchingModel)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        state = model.begin(images(0), images(1))
        for _ in range(2):  # also from predicted states
            together = model.branch(state, PARENT, ACTION)
            alone = model.advance(tuple(part[PARENT] for part in state), ACTION)
            for one, other in zip(together, alone, strict=True):
                torch.testing.assert_close(one, other, rtol=0, atol=1e-2 if bf16 else 1e-5)
            state = tuple(part[:STATES] for part in together)


@pytest.mark.parametrize("bf16", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_a_step_from_a_carried_state_is_one_from_its_frames(name: str, bf16: bool) -> None:
    """Packed states lose nothing: the frames of one, given to ``predict``, lead to the same bits."""
    model, action = built(name), ACTION[:STATES]
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        first, second = images(0), images(1)
        state = model.advance(model.begin(first, second), action)
        wanted = model.predict(second, model.frame(state), action)
        assert torch.equal(model.frame(model.advance(state, action)), wanted)


@pytest.mark.parametrize("bf16", [False, True])
def test_pixels_are_those_of_the_frame(bf16: bool) -> None:
    model = built("dmotion")
    assert isinstance(model, PixelModel)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        state = model.begin(1.2 * images(0), 1.2 * images(1))  # beyond what pixels can hold, too
        assert torch.equal(model.pixels(state), to_pixels(model.frame(state)))


@pytest.mark.parametrize("name", MODELS)
def test_features_are_the_frames(name: str) -> None:
    model, first, second = built(name), images(0), images(1)
    with torch.inference_mode():
        wanted = torch.cat([first.flatten(1), second.flatten(1)], dim=1)
        assert torch.equal(model.features(model.begin(first, second)), wanted)


def test_several_agents_share_the_encoder_as_well() -> None:
    spec = Discrete(tuple(f"{one}/{other}" for one in ("up", "down") for other in ("up", "down")))
    model = built("dmotion", actions=spec, agents=2)
    latent = torch.randn(len(PARENT), 4, generator=torch.Generator().manual_seed(2)) * 0.1
    with torch.inference_mode():
        state = model.begin(images(0), images(1))
        together = model.branch_with_latent(state, PARENT, latent)
        alone = model.branch_with_latent(tuple(part[PARENT] for part in state), None, latent)
        for one, other in zip(together, alone, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=1e-5)
