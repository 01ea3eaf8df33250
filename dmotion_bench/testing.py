"""Conformance: whether anyone's model keeps the contract of ``learning/model.py``.

A package's whole test of its model::

    from dmotion_bench.testing import check_model
    from my_package import MyModel


    def test_my_model_keeps_the_contract() -> None:
        check_model(MyModel)

Each breach has a message of its own, which says what the model did and what is asked. A model that passes trains,
scores, plans and ranks with every command. Nothing is learned here: the weights are the initial ones.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.model import (
    NEITHER,
    PER_TRIPLET,
    ForwardModel,
    Losses,
    ModelInputs,
    Phase,
    TrainingConfig,
    TripletBatch,
)
from dmotion_bench.learning.model_trial import ModelTrial
from dmotion_bench.learning.settings import from_json, to_json
from dmotion_bench.specs import Preset, Supervision
from dmotion_bench.wording import shown

BATCH = 3
STEPS = 3
SIZES = (64, 128)  # [px]
WARM_UP = 3  # steps of training before it is asked whether demonstrations teach anything

CONTINUOUS = Continuous(names=("dx", "dy"), low=(-0.04, -0.02), high=(0.04, 0.06), units=("m", "m"))
"""Continuous actions to check a model with: ``check_model(MyModel, actions=CONTINUOUS)``."""


def check_model(
    kind: type[ForwardModel[Any]], *, arch: str | None = None, size: int | None = None, actions: int | ActionSpec = 4
) -> None:
    """Check a class of models, built small, on contiguous images; channels last, too, if its training asks for that.

    Args:
        kind: The class, as its entry point names it.
        arch: Which of its architectures; the first if left out.
        size: Side of the frames that it is tried on [px]; if left out, 64, or 128 if it refuses 64.
        actions: What can be done: so many discrete actions, or a specification, such as ``CONTINUOUS``.

    A model whose predictions no action changes is no breach, but a warning.

    Raises:
        ModelContractBroken: At the first breach.
    """
    _check_class(kind)
    arch = arch or kind.architectures[0]
    spec = Discrete.numbered(actions) if isinstance(actions, int) else actions
    subject = ModelTrial(kind, arch, _inputs_taken(kind, arch, SIZES if size is None else (size,), spec))
    _check(subject)
    if not any(_tells_actions_apart(subject, steps) for steps in (0, WARM_UP)):
        warnings.warn(
            f"{subject.name}: after {WARM_UP} steps of training predict gives the same frames whatever the action is; "
            "a model that takes no notice of actions cannot be planned with.",
            stacklevel=2,
        )


def check_before_training(kind: type[ForwardModel[Any]], arch: str, inputs: ModelInputs, config: Any = None) -> None:
    """As ``check_model``, on the frames, the actions and the settings of a training.

    Args:
        kind: The class.
        arch: The architecture that is trained.
        inputs: What the model is to be trained for; actions that are not known are taken to be four.
        config: Of the model; the architecture's default if left out.

    Raises:
        ModelContractBroken: At the first breach.
    """
    _check_class(kind)
    told = dataclasses.replace(inputs, actions=inputs.actions or Discrete.numbered(4))
    with torch.random.fork_rng():
        _check(ModelTrial(kind, arch, told, config=config))


def _check(subject: ModelTrial) -> None:
    kind = subject.kind
    _check_settings(kind)
    _check_building(subject)
    _check_phases(subject)
    for phase in subject.build().phases():
        _check_losses(subject, phase)
        _check_validation(subject, phase)
    _check_prediction(subject)
    _check_alignment(subject)
    _check_rollout(subject)
    if any(kind.training_defaults(preset, subject.arch).channels_last for preset in Preset):
        packed = ModelTrial(kind, subject.arch, subject.inputs, channels_last=True, config=subject.config)
        for phase in packed.build().phases():
            _check_losses(packed, phase)
        _check_rollout(packed)


def _inputs_taken(kind: type[ForwardModel[Any]], arch: str, sizes: tuple[int, ...], actions: ActionSpec) -> ModelInputs:
    """The smallest frames on which the model is tried: ``__init__`` may refuse a size by ``InvalidSetting``."""
    said = ""
    for size in sizes:
        inputs = ModelInputs(height=size, width=size, actions=actions)
        try:
            ModelTrial(kind, arch, inputs).build()
        except ModelContractBroken as error:
            if not isinstance(error.__cause__, InvalidSetting):
                return inputs  # what is wrong is said where the building is checked
            said = str(error.__cause__)
        else:
            return inputs
    raise ModelTrial(kind, arch, ModelInputs(height=0, width=0, actions=actions)).broken(
        f"its architecture {arch!r} takes no frames of {' or '.join(map(str, sizes))} pixels ({said}); name a size "
        "that it takes: check_model(..., size=SIDE)"
    )


def _check_class(kind: type[ForwardModel[Any]]) -> None:
    if not (inspect.isclass(kind) and issubclass(kind, ForwardModel)):
        raise ModelContractBroken(f"{kind!r} is no subclass of dmotion_bench.learning.model.ForwardModel.")
    subject = ModelTrial(kind, "", ModelInputs(height=16, width=16, actions=Discrete.numbered(1)))
    lacking = ", ".join(sorted(getattr(kind, "__abstractmethods__", ())))
    subject.require(not lacking, f"it does not define {lacking}")
    subject.require(
        isinstance(getattr(kind, "supervision", None), Supervision),
        f"its class variable supervision is {shown(getattr(kind, 'supervision', None))}; it can be "
        "Supervision.NONE for models that learn from video alone, "
        "Supervision.FEW for those that are given a few beside it, Supervision.ACTIONS for those that are given the "
        "actions of all that they learn from",
    )
    paper = getattr(kind, "paper", None)
    subject.require(isinstance(paper, str) and bool(paper), "its class variable paper says no authors and title")
    config = getattr(kind, "Config", None)
    subject.require(
        dataclasses.is_dataclass(config) and config.__dataclass_params__.frozen,  # type: ignore[union-attr]
        "its class variable Config is no @dataclass(frozen=True, kw_only=True)",
    )
    names = kind.architectures
    subject.require(
        isinstance(names, tuple) and bool(names) and all(isinstance(name, str) for name in names),
        f"its class variable architectures is {names!r}, not a tuple of one name or more",
    )
    own = {name for name in ("predict", "begin", "advance", "frame") if getattr(kind, name) is not _base(name)}
    subject.require(
        "predict" in own or {"begin", "advance", "frame"} <= own,
        NEITHER,
    )


def _base(name: str) -> Any:
    return getattr(ForwardModel, name)


def _check_settings(kind: type[ForwardModel[Any]]) -> None:
    subject = ModelTrial(kind, "", ModelInputs(height=16, width=16, actions=Discrete.numbered(1)))
    for arch in kind.architectures:
        with subject.calling(f"configure({arch!r})"):
            config = kind.configure(arch)
        subject.require(
            isinstance(config, kind.Config), f"configure({arch!r}) gave a {type(config).__name__}, not its Config"
        )
        try:
            kept = from_json(kind.Config, to_json(config)) == config
        except TypeError:
            kept = False
        subject.require(kept, f"its Config does not survive JSON, which run.json keeps it as: {config!r}")
        for preset in Preset:
            with subject.calling(f"training_defaults({preset.value!r}, {arch!r})"):
                training = kind.training_defaults(preset, arch)
            subject.require(
                isinstance(training, TrainingConfig),
                f"training_defaults({preset.value!r}, {arch!r}) gave a {type(training).__name__}, not a TrainingConfig",
            )


def _check_building(subject: ModelTrial) -> None:
    model, again = subject.build(), subject.build()
    subject.require(
        hasattr(model, "config") and hasattr(model, "inputs"), "__init__ does not call super().__init__(config, inputs)"
    )
    subject.require(any(True for _ in model.parameters()), "it has no parameters, so nothing can be trained")
    state = model.state_dict()
    differing = _differing(state, again.state_dict())
    subject.require(
        not differing, f"two models built after the same torch.manual_seed differ in {differing}; a run must repeat"
    )


def _check_phases(subject: ModelTrial) -> None:
    with subject.calling("phases()"):
        phases = subject.build().phases()
    subject.require(
        isinstance(phases, tuple) and bool(phases) and all(isinstance(phase, Phase) for phase in phases),
        f"phases() gave {phases!r}, not a tuple of one Phase or more",
    )
    names = [phase.name for phase in phases]
    subject.require(len(set(names)) == len(names), f"two phases have one name: {names}")
    total = sum(phase.fraction for phase in phases)
    subject.require(math.isclose(total, 1, abs_tol=1e-6), f"the fractions of its phases sum to {total:g}, not to 1")
    asking = [phase.name for phase in phases if phase.needs_actions]
    if subject.kind.supervision is Supervision.NONE:
        subject.require(not asking, f"its supervision is NONE but the phase {asking[:1]} needs actions")
    beside = [phase.name for phase in phases if phase.with_labels]
    if subject.kind.supervision is Supervision.FEW:
        asks = bool(asking or beside)
        subject.require(asks, "its supervision is FEW but no phase needs actions or has labels beside it")
        return
    subject.require(not beside, f"the phase {beside[:1]} has labels beside it, which only Supervision.FEW is given")
    if subject.kind.supervision is Supervision.ACTIONS:
        subject.require(bool(asking), "its supervision is ACTIONS but no phase needs actions")


def _entered(subject: ModelTrial, phase: Phase, *, training: bool) -> ForwardModel[Any]:
    model = subject.build().train(training)
    with subject.calling(f"enter({phase.name!r})"):
        model.enter(phase)
    return model


def _batch_of(subject: ModelTrial, phase: Phase) -> TripletBatch:
    """A batch as the training of a phase has it."""
    shown = phase.needs_actions and subject.kind.supervision is Supervision.FEW  # demonstrations, with nothing before
    earlier = 0 if shown else phase.earlier
    return subject.batch(BATCH, actions=phase.needs_actions, labelled=phase.with_labels, earlier=earlier)


def _losses(subject: ModelTrial, model: ForwardModel[Any], batch: TripletBatch, seed: int = 0) -> Losses:
    with torch.random.fork_rng(), subject.calling("losses(batch)"):
        torch.manual_seed(seed)
        losses = model.losses(batch)
    subject.require(isinstance(losses, Losses), f"losses(batch) gave a {type(losses).__name__}, not Losses")
    total = losses.total
    subject.require(
        total.shape == (), f"losses(batch).total has the shape {tuple(total.shape)}; it is to be one number"
    )
    subject.require(bool(total.isfinite()), f"losses(batch).total is {float(total.detach())} before any training")
    for name, term in losses.terms.items():
        subject.require(
            term.shape == () and not term.requires_grad, f"the term {name!r} of its losses is no detached number"
        )
    hardness = losses.per_triplet
    if hardness is not None:
        subject.require(
            hardness.shape == (len(batch.current),) and not hardness.requires_grad,
            f"losses(batch).per_triplet has the shape {tuple(hardness.shape)}; it is one detached number per triplet",
        )
        subject.require(
            bool((hardness.isfinite() & (hardness >= 0)).all()),
            f"losses(batch).per_triplet is {shown(hardness.tolist())} for some images; {PER_TRIPLET}",
        )
    return losses


def _check_losses(subject: ModelTrial, phase: Phase) -> None:
    """Check losses in training: finite, differentiable, also in bfloat16, and independent of unpaid labels."""
    batch = _batch_of(subject, phase)
    model = _entered(subject, phase, training=True)
    for share in (0.0, 0.5, 0.999):
        with subject.calling(f"progress({share})"):
            model.progress(share)
    before = [tensor.clone() for tensor in (batch.previous, batch.current, batch.next)]
    losses = _losses(subject, model, batch)
    subject.require(
        all(map(torch.equal, before, (batch.previous, batch.current, batch.next))),
        "losses(batch) changes the batch in place",
    )
    subject.require(losses.total.requires_grad, f"losses(batch).total has no gradient in the phase {phase.name!r}")
    with subject.calling("losses(batch).total.backward()"):
        losses.total.backward()  # type: ignore[no-untyped-call]
    gradients = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
    subject.require(
        any(bool(gradient.any()) for gradient in gradients),
        f"no parameter gets a gradient in the phase {phase.name!r}",
    )
    subject.require(
        all(bool(gradient.isfinite().all()) for gradient in gradients),
        f"a gradient is not finite in the phase {phase.name!r}",
    )
    if subject.kind.supervision is Supervision.NONE:
        told = subject.batch(BATCH, actions=True, earlier=phase.earlier)
        blind = _losses(subject, _entered(subject, phase, training=True), batch)
        seeing = _losses(subject, _entered(subject, phase, training=True), told)
        subject.require(
            torch.equal(blind.total, seeing.total), "its supervision is NONE but losses(batch) depends on batch.action"
        )
    halved = _entered(subject, phase, training=True)
    with torch.autocast("cpu", torch.bfloat16):
        _losses(subject, halved, batch).total.backward()  # type: ignore[no-untyped-call]


def _check_validation(subject: ModelTrial, phase: Phase) -> None:
    """Check losses in evaluation: repeatable, for any batch, and without side effects."""
    model = _entered(subject, phase, training=False).eval()
    state = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    batch = subject.batch(BATCH, actions=phase.needs_actions)
    with torch.no_grad():
        first, second = (_losses(subject, model, batch).total for _ in range(2))
        subject.require(torch.equal(first, second), "losses(batch) in evaluation mode differ from one call to the next")
        changed = _differing(state, model.state_dict())
        subject.require(not changed, f"losses(batch) changes {changed} in evaluation mode")
        _losses(subject, model, subject.batch(1, actions=phase.needs_actions))


def _check_alignment(subject: ModelTrial) -> None:
    """Check that ``align`` learns from the demonstrations' actions, and that a checkpoint keeps the result."""
    model, other = _aligned(subject, steps=0)
    if subject.kind.supervision is not Supervision.NONE:
        return
    if not _differing(model.state_dict(), other.state_dict()):
        # a spatial transformer starts at the identity: before any training every demonstration shows the same motion
        model, other = _aligned(subject, steps=WARM_UP)
    subject.require(
        bool(_differing(model.state_dict(), other.state_dict())),
        "align(demonstrations) leaves the same state whichever actions are shown, so it learns nothing that is kept: "
        "what it learns must be in buffers or parameters",
    )
    kept = subject.build().eval()
    with subject.calling("load_state_dict"):
        kept.load_state_dict(model.state_dict())
    inputs = (subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH))
    with torch.no_grad(), subject.calling("predict(previous, current, action)"):
        same = torch.equal(model.predict(*inputs), kept.predict(*inputs))
    subject.require(same, "what align(demonstrations) learned is lost when the weights are saved and loaded")


def _aligned(subject: ModelTrial, *, steps: int) -> tuple[ForwardModel[Any], ForwardModel[Any]]:
    """Two models after so many steps of training in each phase, aligned with the same frames and other actions."""
    models = subject.build(), subject.build()
    for model in models:
        for phase in model.phases():
            with subject.calling(f"enter({phase.name!r})"):
                model.train().enter(phase)
            optimizer = torch.optim.Adam((one for one in model.parameters() if one.requires_grad), lr=1e-2)
            for step in range(steps):
                model.progress(step / steps)
                _losses(subject, model, _batch_of(subject, phase), seed=step).total.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                optimizer.zero_grad()
    with torch.no_grad(), subject.calling("align(demonstrations)"):
        for shift, model in enumerate(models):
            model.eval().align(subject.demonstrations(each=2, shift=shift))
        subject.build().eval().align(subject.demonstrations(each=1))
    return models


def _check_prediction(subject: ModelTrial) -> None:
    model = subject.build().eval()
    previous, current, action = subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH)
    before = previous.clone(), current.clone(), action.clone()
    with torch.no_grad(), subject.calling("predict(previous, current, action)"):
        frames = model.predict(previous, current, action)
    _check_frames(subject, "predict(previous, current, action)", frames, current.shape)
    subject.require(
        all(map(torch.equal, before, (previous, current, action))), "predict changes its arguments in place"
    )
    with torch.no_grad(), subject.calling("predict(previous, current, action)"):
        again = model.predict(previous, current, action)
    subject.require(torch.equal(frames, again), "predict differs from one call to the next with the same arguments")
    with torch.no_grad(), subject.calling("predict(previous, current, action)"):
        alone = torch.cat(
            [model.predict(previous[i : i + 1], current[i : i + 1], action[i : i + 1]) for i in range(BATCH)]
        )
    subject.require(
        torch.allclose(frames, alone, atol=1e-3),
        "predict gives a frame that depends on the other frames of the batch",
    )


def _tells_actions_apart(subject: ModelTrial, steps: int) -> bool:
    """Whether the frames that a model predicts after so many steps of training depend on the action."""
    model, _ = _aligned(subject, steps=steps)
    previous, current, usual = subject.images(BATCH, 1), subject.images(BATCH, 2), subject.actions(BATCH)
    others = [other for shift in range(1, 4) if not torch.equal(other := subject.actions(BATCH, shift), usual)]
    with torch.no_grad(), subject.calling("predict(previous, current, action)"):
        frames = model.eval().predict(previous, current, usual)
        return not others or any(not torch.equal(model.predict(previous, current, one), frames) for one in others)


def _check_rollout(subject: ModelTrial) -> None:
    model = subject.build().eval()
    previous, current = subject.images(BATCH, 1), subject.images(BATCH, 2)
    actions = torch.stack([subject.actions(BATCH, shift) for shift in range(STEPS)], dim=1)
    with torch.no_grad(), subject.calling("begin, advance, frame"):
        state, frames = model.begin(previous, current), []
        for action in actions.unbind(1):
            tensors = state if isinstance(state, tuple) else (state,)
            subject.require(
                all(isinstance(tensor, Tensor) and len(tensor) == BATCH for tensor in tensors),
                "a state is no tensor or tuple of tensors whose first axis is the batch; the planner picks its rows",
            )
            state = model.advance(state, action)
            frames.append(model.frame(state))
    with torch.no_grad(), subject.calling("rollout(previous, current, actions)"):
        rolled = model.rollout(previous, current, actions)
        predicted = model.predict(previous, current, actions[:, 0])
    _check_frames(subject, "rollout(previous, current, actions)", rolled, (BATCH, STEPS, *current.shape[1:]))
    subject.require(
        torch.allclose(rolled, torch.stack(frames, dim=1), atol=1e-4), "rollout differs from begin, advance and frame"
    )
    subject.require(
        torch.allclose(rolled[:, 0], predicted, atol=1e-4), "the first frame of rollout differs from predict"
    )


def _check_frames(subject: ModelTrial, method: str, frames: Any, shape: tuple[int, ...]) -> None:
    subject.require(
        isinstance(frames, Tensor) and frames.shape == shape,
        f"{method} gave {_described(frames)}, not frames of the shape {tuple(shape)}",
    )
    subject.require(frames.dtype == torch.float32, f"{method} gave {frames.dtype}, not torch.float32")
    subject.require(bool(frames.isfinite().all()), f"{method} gave frames that are not finite")


def _described(value: Any) -> str:
    return f"the shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def _differing(state: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> str:
    return ", ".join(name for name in state if not torch.equal(state[name], other[name]))
