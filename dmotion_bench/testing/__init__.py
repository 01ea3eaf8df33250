"""Conformance: whether anyone's model, solver or objective keeps its contract.

A package's whole test of its model::

    from dmotion_bench.testing import check_model
    from my_package import MyModel


    def test_my_model_keeps_the_contract() -> None:
        check_model(MyModel)

and in the same way ``check_solver(MySolver)`` and ``check_objective(MyObjective)``. The parts, each a file::

    trial.py             builds and calls a model under test
    declaration.py       what the class declares: class variables, settings, weights, phases
    losses.py            what is minimised, in training and in validation
    prediction.py        the next frame, and rollouts
    own_optimizer.py     the optimiser that a model may bring
    trained.py           after a few steps: aligned, kept by its checkpoint, dependent on actions
    optional_methods.py  methods that make planning faster, and those that some figures need
    solver.py            a solver: plans that only its context decides, each task as if it were alone
    objective.py         an objective: costs that only states decide
    settings_class.py    that both are frozen dataclasses, complete when constructed
    plane.py             the made-up world that both are tried in

Each breach has a message of its own, which says what the model did and what is asked. A model that passes trains,
scores, plans and ranks with every command. Nothing is learned here but what a few steps on noise teach.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import torch

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.model import ForwardModel, ModelInputs
from dmotion_bench.specs import Preset
from dmotion_bench.testing.declaration import check_building, check_class, check_phases, check_settings
from dmotion_bench.testing.losses import check_losses, check_validation
from dmotion_bench.testing.objective import check_objective
from dmotion_bench.testing.optional_methods import check_optional_methods
from dmotion_bench.testing.own_optimizer import check_optimizer
from dmotion_bench.testing.prediction import check_prediction, check_rollout
from dmotion_bench.testing.solver import check_solver
from dmotion_bench.testing.trained import (
    WARM_UP,
    check_alignment,
    check_checkpoint,
    check_going_on,
    check_memory,
    tells_actions_apart,
)
from dmotion_bench.testing.trial import ModelTrial, specified

__all__ = ["CONTINUOUS", "check_before_training", "check_model", "check_objective", "check_solver"]

SIZES = (64, 128)  # [px]

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
    check_class(kind)
    arch = arch or kind.architectures[0]
    spec = specified(actions)
    subject = ModelTrial(kind, arch, _inputs_taken(kind, arch, SIZES if size is None else (size,), spec))
    _check(subject, bf16=True)
    if not any(tells_actions_apart(subject, steps) for steps in (0, WARM_UP)):
        named, given = subject.predicts
        warnings.warn(
            f"{subject.name}: after {WARM_UP} steps of training {named} gives the same {given}s whatever the action "
            "is; a model that takes no notice of actions cannot be planned with.",
            stacklevel=2,
        )


def check_before_training(
    kind: type[ForwardModel[Any]], arch: str, inputs: ModelInputs, config: Any = None, *, bf16: bool = True
) -> None:
    """As ``check_model``, on the frames, the actions and the settings of a training.

    Args:
        kind: The class.
        arch: The architecture that is trained.
        inputs: What the model is to be trained for; actions that are not known are taken to be four.
        config: Of the model; the architecture's default if left out.
        bf16: Whether the training may compute in bfloat16; hardware without it takes long for that.

    Raises:
        ModelContractBroken: At the first breach.
    """
    check_class(kind)
    told = dataclasses.replace(inputs, actions=inputs.actions or Discrete.numbered(4))
    with torch.random.fork_rng():
        _check(ModelTrial(kind, arch, told, config=config), bf16=bf16)


def _check(subject: ModelTrial, *, bf16: bool) -> None:
    kind = subject.kind
    check_settings(kind)
    check_building(subject)
    check_phases(subject)
    channels_last = any(kind.training_defaults(preset, subject.arch).channels_last for preset in Preset)
    for phase in subject.build().phases():
        check_losses(subject, phase, bf16=bf16 and not channels_last)
        check_validation(subject, phase)
    check_memory(subject)
    check_optimizer(subject)
    check_prediction(subject)
    check_alignment(subject)
    check_rollout(subject)
    check_checkpoint(subject)
    check_going_on(subject)
    check_optional_methods(subject)
    if channels_last:
        packed = ModelTrial(kind, subject.arch, subject.inputs, channels_last=True, config=subject.config)
        for phase in packed.build().phases():
            check_losses(packed, phase, bf16=bf16)
        check_rollout(packed)


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
