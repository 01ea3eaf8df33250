"""What a class of models declares: its class variables, its settings, its weights and the parts of its training."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Any, Final

from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.model import NEITHER, ForwardModel, ModelInputs, Phase, TrainingConfig
from dmotion_bench.learning.settings import from_json, to_json
from dmotion_bench.specs import Preset, Supervision
from dmotion_bench.testing.trial import ModelTrial, differing
from dmotion_bench.values import is_frozen_dataclass
from dmotion_bench.wording import shown

OPTIONAL_METHODS: Final = (
    *("latent_action", "predict_with_latent", "agent_map", "agent_maps", "agent_motions", "pixel_shift"),
    *("infer_action", "chosen_codes", "embedding", "branch", "branch_with_latent", "pixels", "features"),
    *("feature_maps", "moved_maps"),
)
"""Methods of the protocols that scoring, planning and viewing ask a model for."""

_OF_TRAINING: Final = {field.name for field in dataclasses.fields(TrainingConfig)}


def check_class(kind: type[ForwardModel[Any]]) -> None:
    """Check the class variables."""
    if not (inspect.isclass(kind) and issubclass(kind, ForwardModel)):
        raise ModelContractBroken(f"{kind!r} is no subclass of dmotion_bench.learning.model.ForwardModel.")
    subject = _unbuilt(kind)
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
    config: Any = getattr(kind, "Config", None)
    subject.require(
        is_frozen_dataclass(config),
        "its class variable Config is no @dataclass(frozen=True, kw_only=True)",
    )
    shared = sorted({field.name for field in dataclasses.fields(config)} & _OF_TRAINING)
    subject.require(
        not shared,
        f"its Config has fields of TrainingConfig ({', '.join(shared)}), so '--set' would not reach the training's; "
        "give the training's values in training_defaults, and other fields other names",
    )
    names = kind.architectures
    subject.require(
        isinstance(names, tuple) and bool(names) and all(isinstance(name, str) for name in names),
        f"its class variable architectures is {names!r}, not a tuple of one name or more",
    )
    own = {name for name in ("predict", "begin", "advance", "frame") if getattr(kind, name) is not _base(name)}
    subject.require(
        {"begin", "advance"} <= own
        if not kind.needs_pixels
        else "predict" in own or {"begin", "advance", "frame"} <= own,
        NEITHER if kind.needs_pixels else "its needs_pixels is False and it does not define both begin and advance",
    )


def _base(name: str) -> Any:
    return getattr(ForwardModel, name)


def _unbuilt(kind: type[ForwardModel[Any]]) -> ModelTrial:
    return ModelTrial(kind, "", ModelInputs(height=16, width=16, actions=Discrete.numbered(1)))


def check_settings(kind: type[ForwardModel[Any]]) -> None:
    """Check that the settings of each architecture can be kept, and those of its training."""
    subject = _unbuilt(kind)
    for arch in kind.architectures:
        with subject.calling(f"configure({arch!r})"):
            config = kind.configure(arch)
        subject.require(
            isinstance(config, kind.Config), f"configure({arch!r}) gave a {type(config).__name__}, not its Config"
        )
        try:
            kept, why = from_json(kind.Config, to_json(config)) == config, "another one is read back"
        except (TypeError, InvalidSetting) as error:
            kept, why = False, str(error).rstrip(".")
        subject.require(kept, f"its Config does not survive JSON, which run.json keeps it as: {config!r} ({why})")
        for preset in Preset:
            with subject.calling(f"training_defaults({preset.value!r}, {arch!r})"):
                training = kind.training_defaults(preset, arch)
            subject.require(
                isinstance(training, TrainingConfig),
                f"training_defaults({preset.value!r}, {arch!r}) gave a {type(training).__name__}, not a TrainingConfig",
            )


def check_building(subject: ModelTrial) -> None:
    """Check that a model can be built, the same each time, and that a checkpoint can hold it."""
    model, again = subject.build(), subject.build()
    subject.require(
        hasattr(model, "config") and hasattr(model, "inputs"), "__init__ does not call super().__init__(config, inputs)"
    )
    subject.require(any(True for _ in model.parameters()), "it has no parameters, so nothing can be trained")
    state = model.state_dict()
    for name, value in state.items():
        subject.require(
            isinstance(value, Tensor),
            f"its state_dict() holds {name!r}, a {type(value).__name__}; a checkpoint holds tensors alone",
        )
        subject.require(
            not is_lazy(value),
            f"its weights {name!r} have no shape before the first batch, as those of lazy modules; give the layer all "
            "of its sizes",
        )
    check_names(subject, model)
    unlike = differing(state, again.state_dict())
    subject.require(
        not unlike, f"two models built after the same torch.manual_seed differ in {unlike}; a run must repeat"
    )


def check_names(subject: ModelTrial, model: ForwardModel[Any]) -> None:
    """Check that no layer has the name of a method: the method would hide it, or it would be called in its place."""
    for name, _ in model.named_children():
        subject.require(
            not hasattr(type(model), name),
            f"its layer {name!r} has the name of an attribute of the class, which hides it; "
            "give the layer another name",
        )
    for name in OPTIONAL_METHODS:
        value = getattr(model, name, None)
        subject.require(
            value is None or (callable(value) and not isinstance(value, nn.Module)),
            f"its attribute {name!r} is of the type {type(value).__name__}; this is the name of a method that a model "
            "may offer (docs/your_model.md), and it would be called, so give the attribute another name",
        )


def check_phases(subject: ModelTrial) -> None:
    """Check the parts of its training."""
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
        subject.require(
            bool(asking), "its supervision is ACTIONS but no phase needs actions; give one Phase(needs_actions=True)"
        )
