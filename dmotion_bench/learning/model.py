"""The contract of a forward model: what a class must do to be trained, scored, planned with and ranked.

A model is an ``nn.Module`` built from a frozen config and the facts of the data. It learns from triplets
of consecutive frames; a model of ``Supervision.NONE`` never sees an action while it learns, and is told
afterwards, by a few demonstrations, which of its own latent actions belongs to which named action.

Images are ``Float[b c h w]`` in [-1, 1]. Axis letters: ``b`` batch, ``t`` time, ``c h w`` image.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final, Generic, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.action_encoding import Actions
from dmotion_bench.learning.boundary import guarded
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.settings import only_with
from dmotion_bench.specs import Preset, Supervision
from dmotion_bench.values import require_bounds

__all__ = ["Demonstrations", "ForwardModel", "Losses", "ModelInputs", "Phase", "TrainingConfig", "TripletBatch"]


@dataclass(frozen=True, kw_only=True)
class ModelInputs:
    """The facts of a data set that a model is built for.

    Attributes:
        height, width: Of a frame [px].
        actions: What can be done at each step; None where it is unknown. ``ActionEncoding`` makes vectors of them.
    """

    height: int
    width: int
    actions: ActionSpec | None


@dataclass(frozen=True, kw_only=True)
class TripletBatch:
    """Three consecutive frames; the action that led from the second to the third where it was paid for.

    ``action`` is None in the training of unsupervised models, always. ``episode`` says which of them are moments of one
    recording, for losses that compare moments; it is no label. Only batches of demonstrations alone have none.
    ``labelled`` are the few labelled transitions that stand beside a batch of video in a phase that asks for them
    (``Phase.with_labels``); in validation there are none. ``earlier`` are the frames before ``previous``, in a phase
    that asks for them (``Phase.earlier``); where an episode has none, its first frame is repeated. ``history`` says how
    many are not repeated. In a phase that needs actions, ``earlier_action`` are the actions taken at
    ``earlier[:, 1:]`` and ``previous``; of these the last ``history`` were paid for, the others repeat the first of
    them or, where there is none, ``action``.
    """

    previous: Float[Tensor, "b c h w"]
    current: Float[Tensor, "b c h w"]
    next: Float[Tensor, "b c h w"]
    action: Actions | None = None
    episode: Int[Tensor, " b"] | None = None
    labelled: Demonstrations | None = None
    earlier: Float[Tensor, "b k c h w"] | None = None
    earlier_action: Int[Tensor, "b k"] | Float[Tensor, "b k a"] | None = None
    history: Int[Tensor, " b"] | None = None

    def contiguous(self) -> TripletBatch:
        """The same triplets, their images contiguous in memory."""
        frames = {one: getattr(self, one).contiguous() for one in ("previous", "current", "next")}
        earlier = None if self.earlier is None else self.earlier.contiguous()
        return replace(self, **frames, labelled=self.labelled and self.labelled.contiguous(), earlier=earlier)


@dataclass(frozen=True, kw_only=True)
class Losses:
    """The loss to minimise and its named terms, for the curves.

    Attributes:
        total: What is differentiated.
        terms: Detached scalars by name; ``validation`` figures that are not minimised may stand here too.
        per_triplet: Detached loss of each triplet of the batch, for ``TrainingConfig.hard_share``; finite and not below
            zero.
    """

    total: Float[Tensor, ""]
    terms: Mapping[str, Float[Tensor, ""]] = field(default_factory=dict)
    per_triplet: Float[Tensor, " b"] | None = None


PER_TRIPLET: Final = "it is a finite loss of each triplet, and none is below zero"
"""What the contract says of ``Losses.per_triplet``."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One part of a training: most models have one, a world model learns its code first, then its dynamics.

    Attributes:
        name: Given to ``ForwardModel.enter``.
        fraction: Of the training's triplets.
        needs_actions: Whether only labelled triplets are of use in this phase.
        with_labels: So many labelled triplets stand beside each batch of video (``TripletBatch.labelled``), or all of
            them where the budget gives fewer; only of ``Supervision.FEW``.
        batch_size: Triplets a step, where a phase wants another number than the training's.
        together: So many triplets of one episode, any of its moments, stand side by side in a batch, whose size is
            rounded down to whole groups. Episodes with fewer are left out, unless all have fewer.
        earlier: So many frames before each triplet come along (``TripletBatch.earlier``), for models that train on
            several steps, in a phase that needs actions with theirs; with triplets out of demonstrations, and in
            validation, there are none.
    """

    name: str = "train"
    fraction: float = 1.0
    needs_actions: bool = False
    with_labels: int = 0
    batch_size: int | None = None
    together: int = 1
    earlier: int = 0


_FINETUNED: Final[Any] = ("adaptation=finetuned", lambda config: config.adaptation == "finetuned")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How a model is optimised.

    Attributes:
        epochs: Passes over the training triplets.
        batch_size: Triplets a step.
        learning_rate: Peak of the schedule.
        schedule: ``"one-cycle"`` (warm-up, then cosine to zero), ``"linear"`` (warm-up, then a line to zero),
            ``"cosine"`` or ``"constant"``.
        optimizer: ``"adamw"``, ``"adam"`` or ``"muon"``.
        weight_decay: Of weights, not of biases and gains: decoupled, AdamW's, also with ``"muon"``; with ``"adam"`` it
            is added to the gradient.
        clip_norm: Largest norm of the gradient; 0 leaves it alone.
        precision: ``"bf16"`` autocast where the hardware has it, ``"float32"``, or ``"auto"``: whichever takes less
            time here (``precision.py``).
        channels_last: Memory format of images and weights: channels last, which convolutions on a CPU like best, or
            contiguous, which a model needs that calls ``view`` on what a convolution gives.
        ema: Decay of the averaged weights that are validated and kept; 0 keeps the raw ones.
        hard_share: Share of each batch, after the first epoch, that is drawn by the square roots of the
            triplets' latest losses instead of evenly. Rare events, such as pushes, are seen more often. Of a phase with
            ``Phase.together`` whole groups are drawn, by their mean losses. Batches of a model that tells no
            ``Losses.per_triplet`` stay as they are.
        validations: How many times the run is validated and its checkpoint written.
        patience: A phase ends after so many validations in a row without a lower loss; 0 takes all of its steps. The
            weights with the lowest loss are kept in either case.
        window: Triplets that are shuffled among each other while they are read from the compressed files; 0 shuffles
            all of them, which takes the frame cache.
        adaptation: What the demonstrations change in a model of video: ``"averaged"`` its map from actions to latent
            ones alone (``ForwardModel.align``), which ``"clustered"`` then corrects by unlabelled video
            (``clustering.py``), ``"finetuned"`` then all of it, end to end (``adaptation.py``).
        adaptation_steps: At most so many steps of Adam in a fine-tuning.
        adaptation_rate: Of its learning.
    """

    epochs: float
    batch_size: int = 32
    learning_rate: float = 1e-3
    schedule: str = "one-cycle"
    optimizer: str = "adamw"
    weight_decay: float = 0.0
    clip_norm: float = 1.0
    precision: str = "auto"
    channels_last: bool = False
    ema: float = 0.0
    hard_share: float = 0.0
    validations: int = 10
    patience: int = 0
    window: int = 0
    adaptation: str = "averaged"
    adaptation_steps: int = only_with(200, *_FINETUNED)
    adaptation_rate: float = only_with(1e-4, *_FINETUNED)

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("schedule", self.schedule, ("one-cycle", "linear", "cosine", "constant")),
            ("optimizer", self.optimizer, ("adamw", "adam", "muon")),
            ("precision", self.precision, ("auto", "bf16", "float32")),
            ("adaptation", self.adaptation, ("averaged", "clustered", "finetuned")),
        ):
            if value not in allowed:
                raise InvalidSetting(f"{name} is {value!r}; it can be {', '.join(allowed)}.")
        require_bounds(
            self,
            above_zero=("epochs", "batch_size", "learning_rate", "validations", "adaptation_steps", "adaptation_rate"),
            from_zero=("weight_decay", "clip_norm", "window", "patience"),
            below_one=("hard_share", "ema"),
        )


ConfigT = TypeVar("ConfigT")
NEITHER: Final = "it defines neither predict nor all of begin, advance and frame"
State = Any
"""What a model carries from step to step of a rollout: a tuple of tensors whose first axis is the batch."""


class ForwardModel(nn.Module, ABC, Generic[ConfigT]):
    """Predicts the next frame from the last two and an action.

    Subclasses set the class variables, take ``(config, inputs)`` and implement ``losses`` and either
    ``predict`` (models of pixels) or ``begin``, ``advance`` and ``frame`` (models that roll out in a
    latent space).
    """

    supervision: ClassVar[Supervision]
    paper: ClassVar[str]  # authors, title, venue, year
    Config: ClassVar[type]
    architectures: ClassVar[tuple[str, ...]] = ("compact",)
    budgets: ClassVar[tuple[str, ...]] = ()  # label budgets it is ranked under; those of its supervision if empty
    needs_pixels: ClassVar[bool] = True  # whether frames it predicts are meant to look like frames
    channels_last: bool = False
    """Whether images come channels last in memory; a run sets it as its ``TrainingConfig`` says."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name, method in list(vars(cls).items()):
            if inspect.isfunction(method):
                setattr(cls, name, guarded(method, name))

    def __init__(self, config: ConfigT, inputs: ModelInputs) -> None:
        super().__init__()
        self.config, self.inputs = config, inputs

    @classmethod
    def configure(cls, arch: str) -> ConfigT:
        """The config of one of ``architectures``; the first is the default."""
        config: ConfigT = cls.Config() if len(cls.architectures) == 1 else cls.Config(arch=arch)
        return config

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """The training settings of this model at a preset."""
        return TrainingConfig(epochs={Preset.TINY: 1, Preset.SMALL: 10, Preset.PAPER: 50}[preset])

    def laid_out(self, *, channels_last: bool | None = None) -> ForwardModel[ConfigT]:
        """The model itself, its weights in the memory format of its images.

        Args:
            channels_last: Another format than before.
        """
        if channels_last is not None:
            self.channels_last = channels_last
        if self.channels_last:
            self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return self

    def make_optimizer(self, config: TrainingConfig) -> torch.optim.Optimizer | None:
        """An optimiser of the model's own over its parameters; None for the one that ``config.optimizer`` names.

        Before every step the rate of each group is set to its own ``lr`` here times the schedule, so ``lr`` is the
        peak. Gradients are clipped and weights averaged as ``config`` says. What the optimiser keeps of a parameter
        must be tensors and numbers, which a checkpoint can hold, and its ``step`` must need no closure.
        """
        return None

    def phases(self) -> tuple[Phase, ...]:
        """The parts of a training, in order; their fractions sum to one. One part by default, with labels if any."""
        return (Phase(needs_actions=self.supervision is Supervision.ACTIONS),)

    def enter(self, phase: Phase) -> None:
        """Called before a phase's first step, on resuming within it and after each validation: freeze here.

        It leaves all weights and buffers as they are. What is to happen once belongs to ``progress(0.0)``.
        """

    def progress(self, share: float) -> None:
        """Called before every step with the share of the phase that is done, in [0, 1): anneal here."""

    @abstractmethod
    def losses(self, batch: TripletBatch) -> Losses:
        """The loss of a batch. ``batch.action`` is there only in phases that need actions."""

    def align(self, demonstrations: Demonstrations) -> None:
        """Learn which latent action each named action is; supervised models have nothing to learn here.

        What is learnt must live in buffers or parameters, so that the checkpoint keeps it.
        """

    @guarded
    def predict(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        action: Actions,
    ) -> Float[Tensor, "b c h w"]:
        """The frame after ``current`` if ``action`` is taken at it, in [-1, 1].

        Raises:
            ModelContractBroken: The model defines neither this method nor ``advance``.
        """
        self._require_own("advance")
        return self.frame(self.advance(self.begin(previous, current), action))

    @guarded
    def begin(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> State:
        """The state that a rollout starts from."""
        return previous, current

    @guarded
    def advance(self, state: State, action: Actions) -> State:
        """The state one action later.

        Raises:
            ModelContractBroken: The model defines neither this method nor ``predict``.
        """
        self._require_own("predict")
        previous, current = state
        return current, self.predict(previous, current, action)

    def _require_own(self, method: str) -> None:
        """Refuse to go round in circles: by default ``predict`` calls ``advance``, which calls ``predict``."""
        if getattr(type(self), method) is getattr(ForwardModel, method):
            raise ModelContractBroken(f"{type(self).__qualname__}: {NEITHER}; define one or the others.")

    def frame(self, state: State) -> Float[Tensor, "b c h w"]:
        """The frame of a state, in [-1, 1]."""
        frame: Tensor = state[1]
        return frame

    @guarded
    def rollout(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        actions: Int[Tensor, "b t"] | Float[Tensor, "b t a"],
    ) -> Float[Tensor, "b t c h w"]:
        """The frames that a sequence of actions leads to, each predicted from the model's own last ones."""
        state, frames = self.begin(previous, current), []
        for action in actions.unbind(1):
            state = self.advance(state, action)
            frames.append(self.frame(state))
        return torch.stack(frames, dim=1)
