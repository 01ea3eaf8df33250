"""What a caller hands to a model: stored frames and plain numbers are understood, anything else is a sentence."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from baselines.dmotion import DMotion, DMotionConfig
from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import UsageError
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel, ModelInputs

SIDE = 32
FRAMES = np.random.default_rng(0).integers(0, 256, (3, SIDE, SIDE, 3), dtype=np.uint8)
IMAGES = to_model(torch.from_numpy(FRAMES))


@pytest.fixture(scope="module")
def model() -> DMotion:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = DMotion(DMotionConfig(), ModelInputs(height=SIDE, width=SIDE, actions=Discrete.numbered(4))).eval()
    made.table.rows += torch.arange(4.0)[:, None] / 10
    return made


@pytest.mark.parametrize(
    "frames", [FRAMES, torch.from_numpy(FRAMES), torch.from_numpy(FRAMES).movedim(-1, 1).contiguous()]
)
@torch.no_grad()
def test_stored_frames_are_the_images_that_they_hold(model: DMotion, frames: Any) -> None:
    expected = model.predict(IMAGES, IMAGES, torch.tensor([1, 2, 3]))
    assert torch.equal(model.predict(frames, frames, torch.tensor([1, 2, 3])), expected)
    assert torch.equal(model.latent_action(frames, frames, frames), model.latent_action(IMAGES, IMAGES, IMAGES))


@pytest.mark.parametrize("action", [2, [2, 2, 2], (2, 2, 2), np.array([2, 2, 2]), np.int64(2), torch.tensor(2)])
@torch.no_grad()
def test_a_plain_action_is_every_rows(model: DMotion, action: Any) -> None:
    expected = model.predict(IMAGES, IMAGES, torch.tensor([2, 2, 2]))
    assert torch.equal(model.predict(IMAGES, IMAGES, action), expected)
    assert torch.equal(model.frame(model.advance(model.begin(IMAGES, IMAGES), action)), expected)
    assert torch.equal(model.predict(previous=IMAGES, action=action, current=IMAGES), expected)


@torch.no_grad()
def test_a_rollout_takes_one_sequence_for_all_or_one_a_row(model: DMotion) -> None:
    expected = model.rollout(IMAGES, IMAGES, torch.tensor([[1, 3]] * 3))
    assert torch.equal(model.rollout(FRAMES, FRAMES, [1, 3]), expected)
    assert torch.equal(model.rollout(FRAMES, FRAMES, [[1, 3]] * 3), expected)


SENTENCES: dict[str, tuple[Callable[[DMotion], Any], str]] = {
    "no batch": (lambda m: m.predict(FRAMES[0], FRAMES[0], 1), r"given uint8 of the shape \(32, 32, 3\) as images"),
    "other size": (lambda m: m.predict(FRAMES[:, :16], FRAMES, 1), r"takes .* \(b, 3, 32, 32\) .* \(b, 32, 32, 3\)"),
    "whole numbers": (lambda m: m.predict(IMAGES.int(), IMAGES, 1), r"given int32 of the shape .*to_model"),
    "a path": (lambda m: m.rollout("frame.png", IMAGES, [1]), r"rollout\(\) was given 'frame.png' as images"),
    "unknown action": (
        lambda m: m.predict(IMAGES, IMAGES, 4),
        r"given action 4 in row 0; there are 4, numbered from 0",
    ),
    "negative": (lambda m: m.predict(IMAGES, IMAGES, [0, -1, 0]), r"given action -1 in row 1"),
    "a name": (lambda m: m.predict(IMAGES, IMAGES, "left"), r"given 'left' as actions; .* whole numbers"),
    "half": (lambda m: m.predict(IMAGES, IMAGES, 1.5), r"given 1.5 as actions"),
    "too few": (lambda m: m.predict(IMAGES, IMAGES, [1, 2]), r"of the shape \(3,\), a row for each of the 3 images"),
    "ragged": (lambda m: m.rollout(IMAGES, IMAGES, [[1, 2], [3]]), r"given \[\[1, 2\], \[3\]\] as actions"),
    "no sequence": (lambda m: m.rollout(IMAGES, IMAGES, 1), r"of the shape \(3, steps\).*one sequence for all"),
    "latent": (lambda m: m.agent_map(FRAMES[0]), r"DMotion.agent_map\(\) was given uint8"),
}


@pytest.mark.parametrize("name", SENTENCES)
def test_anything_else_is_a_sentence(model: DMotion, name: str) -> None:
    call, said = SENTENCES[name]
    with pytest.raises(UsageError, match=said):
        call(model)


def test_images_come_in_the_memory_format_that_the_training_asks_for(model: DMotion) -> None:
    seen: list[bool] = []

    class Watching(DMotion):
        def predict(self, previous: Any, current: Any, action: Any) -> Any:
            seen.append(current.is_contiguous())
            return current

    watching = Watching(model.config, model.inputs)
    assert not IMAGES.is_contiguous()
    for channels_last in (False, True):
        watching.laid_out(channels_last=channels_last).predict(IMAGES, IMAGES, 0)
        weight = next(one for one in watching.parameters() if one.ndim == 4 and min(one.shape) > 1)
        assert weight.is_contiguous(memory_format=torch.channels_last) is channels_last
    assert seen == [True, False]


def test_batches_may_be_named_as_the_contract_names_them(model: DMotion) -> None:
    shown = Demonstrations(previous=IMAGES, current=IMAGES, next=IMAGES, action=torch.tensor([0, 1, 2]))
    with torch.no_grad():
        one, two = copy.deepcopy(model), copy.deepcopy(model)
        one.align(shown)
        two.align(demonstrations=shown)
    assert torch.equal(one.table.rows, two.table.rows)
    with pytest.raises(TypeError, match=r"missing .*'demonstrations'"):
        model.align()  # type: ignore[call-arg]


def test_what_the_base_class_offers_is_guarded_too() -> None:
    class Still(ForwardModel[None]):
        def losses(self, batch: Any) -> Any:
            raise NotImplementedError

        def begin(self, previous: Any, current: Any) -> Any:
            return (current,)

        def advance(self, state: Any, action: Any) -> Any:
            assert action.tolist() == [1, 1, 1]
            return state

        def frame(self, state: Any) -> Any:
            return state[0]

    still = Still(None, ModelInputs(height=SIDE, width=SIDE, actions=Discrete.numbered(2)))
    assert torch.equal(still.predict(FRAMES, FRAMES, 1), IMAGES)
    assert torch.equal(still.rollout(FRAMES, FRAMES, [1, 1])[:, 1], IMAGES)


def test_continuous_actions_are_rows_of_numbers_within_their_bounds() -> None:
    spec = Continuous(names=("dx", "dy"), low=(-0.1, -0.1), high=(0.1, 0.1), units=("m", "m"))
    model = DMotion(DMotionConfig(), ModelInputs(height=SIDE, width=SIDE, actions=spec)).eval()
    rows = np.array([[0.0, 0.1], [-0.1, 0.0], [0.05, 0.05]])
    with torch.no_grad():
        model.table.rows.copy_(torch.tensor([[0.1, 0.0], [0.3, 0.0], [0.0, 0.4]]))
        expected = model.predict(IMAGES, IMAGES, torch.from_numpy(rows))
        for given in (rows, rows.tolist(), rows.astype(np.float32)):
            assert torch.equal(model.predict(IMAGES, IMAGES, given), expected)
        one = model.predict(IMAGES, IMAGES, rows[0])
        assert torch.equal(one[0], expected[0])
        assert torch.equal(one[1], model.predict(IMAGES, IMAGES, rows[[0, 0, 0]])[1])
        rolled = model.rollout(IMAGES, IMAGES, np.stack([rows, rows[::-1]], axis=1))
        torch.testing.assert_close(rolled[:, 0], expected)
        assert torch.equal(model.rollout(IMAGES, IMAGES, rows)[:, 0], one)  # three steps, the same for all images
    for wrong, said in (
        ([[0.0, 0.2]] * 3, r"given 'dy' = 0.2 in row 0; it can be -0.1 to 0.1 m"),
        (torch.tensor([[0.0, 0.0], [torch.nan, 0.0], [0.0, 0.0]]), r"given 'dx' = nan in row 1"),
        ([0, 1, 2], r"as actions; it takes numbers of the shape \(3, 2\)"),
        (1, r"as actions; it takes numbers of the shape \(3, 2\)"),
        ("left", r"given 'left' as actions; it takes numbers"),
    ):
        with pytest.raises(UsageError, match=said):
            model.predict(IMAGES, IMAGES, wrong)


@pytest.mark.parametrize(("action", "said"), [([-1, 0, 0], "action -1 in row 0"), ([0, 99, 0], "action 99 in row 1")])
def test_tensors_of_actions_are_checked_as_numbers_are(model: DMotion, action: list[int], said: str) -> None:
    for given in (torch.tensor(action), np.array(action)):
        with pytest.raises(UsageError, match=rf"given {said}; there are 4, numbered from 0"):
            model.predict(IMAGES, IMAGES, given)
        with pytest.raises(UsageError, match=said):
            model.advance(model.begin(IMAGES, IMAGES), given)
