"""Builds and calls a model under test, and turns every failure into ``ModelContractBroken``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.action_encoding import Actions, as_tensor
from dmotion_bench.learning.model import Demonstrations, ForwardModel, ModelInputs, TripletBatch
from dmotion_bench.planning.dynamics.model import ModelDynamics

BATCH: Final = 3
"""Images that a model is tried on at once."""
GOLDEN: Final = (5**0.5 - 1) / 2  # its multiples are spread evenly over the unit interval


class ModelTrial:
    """A model class under test, with the inputs that it is tried on.

    Args:
        kind: The class.
        arch: Which of its architectures.
        inputs: What its models are built for.
        channels_last: Memory format of images and weights.
        config: Of its models; the architecture's default if left out.
    """

    def __init__(
        self,
        kind: type[ForwardModel[Any]],
        arch: str,
        inputs: ModelInputs,
        *,
        channels_last: bool = False,
        config: Any = None,
    ) -> None:
        self.kind, self.arch, self.inputs, self.channels_last = kind, arch, inputs, channels_last
        self.config = config
        asked = " on channels-last images, which its training_defaults ask for (TrainingConfig.channels_last)"
        assert inputs.actions is not None, "a trial shows actions"
        self._spec = inputs.actions
        self.name = kind.__qualname__ + (asked if channels_last else "")

    @property
    def has_one_action(self) -> bool:
        """Whether there is a single action, so that all demonstrations show the same one."""
        return isinstance(self._spec, Discrete) and len(self._spec) == 1

    def build(self, *, seed: int = 0) -> ForwardModel[Any]:
        """A new model, the same each time."""
        with torch.random.fork_rng(), self.calling("__init__(config, inputs)"):
            torch.manual_seed(seed)
            config = self.kind.configure(self.arch) if self.config is None else self.config
            model = self.kind(config, self.inputs)
            self.require(
                torch.initial_seed() == seed,
                "__init__ seeds torch's generator, so all seeds of a training would begin with the same weights; leave "
                "torch.manual_seed out, or call it within torch.random.fork_rng()",
            )
            return model.laid_out(channels_last=True) if self.channels_last else model

    def images(self, count: int, seed: int) -> Float[Tensor, "n c h w"]:
        """Noise in [-1, 1]."""
        generator = torch.Generator().manual_seed(seed)
        shape = (count, 3, self.inputs.height, self.inputs.width)
        images = torch.rand(shape, generator=generator) * 2 - 1
        return images.contiguous(memory_format=torch.channels_last) if self.channels_last else images

    def actions(self, count: int, shift: int = 0) -> Actions:
        """A batch of actions: every discrete one in turn, or continuous ones spread over their bounds.

        Args:
            shift: Another number gives other actions in the same order.
        """
        spec = self._spec
        place = np.arange(count) + shift
        if isinstance(spec, Discrete):
            return as_tensor(place % len(spec))
        turns = place[:, None] * np.arange(1, spec.width + 1) * GOLDEN
        return as_tensor(spec.denormalise(2 * (turns % 1) - 1))

    def batch(self, count: int, *, actions: bool, labelled: int = 0, earlier: int = 0) -> TripletBatch:
        """Triplets, with or without their actions; perhaps with a few labelled ones beside them, or earlier frames."""
        return TripletBatch(
            previous=self.images(count, 1),
            current=self.images(count, 2),
            next=self.images(count, 3),
            action=self.actions(count) if actions else None,
            episode=torch.arange(count) // 2,
            labelled=self.demonstrations(each=1) if labelled else None,
            earlier=torch.stack([self.images(count, 7 + place) for place in range(earlier)], 1) if earlier else None,
            earlier_action=torch.stack([self.actions(count, place) for place in range(earlier)], 1)
            if earlier and actions
            else None,
            history=torch.arange(count) % (earlier + 1) if earlier else None,
        )

    def demonstrations(self, each: int, shift: int = 0) -> Demonstrations:
        """So many of each action, or for each number of one; with another ``shift`` the same frames show other ones."""
        count = each * self._spec.width
        return Demonstrations(
            previous=self.images(count, 4),
            current=self.images(count, 5),
            next=self.images(count, 6),
            action=self.actions(count, shift),
        )

    @property
    def draws(self) -> bool:
        """Whether its models draw frames; others are looked at by the features of their states."""
        return self.kind.needs_pixels

    @property
    def predicts(self) -> tuple[str, str]:
        """The method that a model predicts by, and what it gives one of."""
        return ("predict", "frame") if self.draws else ("advance", "state")

    @property
    def prediction(self) -> str:
        """A call of that method."""
        return "predict(previous, current, action)" if self.draws else "advance(state, action)"

    def look(self, model: ForwardModel[Any], state: Any) -> Float[Tensor, "n *d"]:
        """What is compared of a state: its frame, or what planning compares for a model that draws none."""
        return model.frame(state) if self.draws else ModelDynamics(model).features(state)

    def look_ahead(
        self,
        model: ForwardModel[Any],
        previous: Float[Tensor, "n c h w"],
        current: Float[Tensor, "n c h w"],
        action: Any,
    ) -> Float[Tensor, "n *d"]:
        """The same, one action later."""
        if self.draws:
            return model.predict(previous, current, action)
        return self.look(model, model.advance(model.begin(previous, current), action))

    @contextlib.contextmanager
    def calling(self, method: str) -> Iterator[None]:
        """Turn an error of the model into one that names the method."""
        try:
            yield
        except ModelContractBroken:
            raise
        except Exception as error:
            raise self.broken(f"{method} raised {type(error).__name__}: {error}") from error

    def require(self, holds: bool, sentence: str) -> None:
        """Raise an error that says what is broken, unless the condition holds."""
        if not holds:
            raise self.broken(sentence)

    def broken(self, sentence: str) -> ModelContractBroken:
        """The error for a breach."""
        said = sentence.rstrip(".")
        return ModelContractBroken(f"{self.name}: {said}. The contract is in dmotion_bench/learning/model.py.")


def specified(actions: int | ActionSpec) -> ActionSpec:
    """So many discrete actions, or a specification as it is."""
    return Discrete.numbered(actions) if isinstance(actions, int) else actions


def described(value: Any) -> str:
    """What was given in the place of what was asked for."""
    return f"the shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def differing(state: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> str:
    """The names of the tensors in which two states differ; one that is no number is equal to another such one."""
    return ", ".join(name for name in state if not same(state[name], other[name]))


def same(one: Tensor, other: Tensor) -> bool:
    """Whether two tensors hold the same bits, or NaN in the same places."""
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    return bool(((one == other) | ((one != one) & (other != other))).all())
