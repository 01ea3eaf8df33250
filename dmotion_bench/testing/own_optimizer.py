"""An optimiser that a model brings: it takes steps alone, and a checkpoint holds what it keeps."""

from __future__ import annotations

from numbers import Real
from typing import Any

import torch
from torch import Tensor

from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.training.optimizer import has_own_optimizer, optimizer_of
from dmotion_bench.specs import Preset
from dmotion_bench.testing.trial import ModelTrial
from dmotion_bench.wording import shown

_METHOD = "make_optimizer(config)"


def check_optimizer(subject: ModelTrial) -> None:
    """Check the optimiser of a model that brings one: what it keeps after a step, and that it can be put back."""
    model = subject.build()
    if not has_own_optimizer(model):
        return
    optimizer = _stepped(subject, model)
    for state in optimizer.state_dict()["state"].values():
        for name, value in state.items():
            subject.require(
                isinstance(value, Tensor | Real),
                f"the optimiser of {_METHOD} keeps {shown(value)} as {name!r} of a parameter; a checkpoint holds "
                "tensors and numbers",
            )
    another = _stepped(subject, subject.build())
    with subject.calling(f"load_state_dict of the optimiser of {_METHOD}"):
        checkpoint.restore_optimizer(another, checkpoint.optimizer_tensors(optimizer))
        another.step()


def _stepped(subject: ModelTrial, model: ForwardModel[Any]) -> torch.optim.Optimizer:
    """The optimiser of a model after a step with gradients of zero."""
    with subject.calling(_METHOD):
        optimizer = optimizer_of(model, subject.kind.training_defaults(Preset.SMALL, subject.arch))
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    with subject.calling(f"step() of the optimiser of {_METHOD}"):
        optimizer.step()
    return optimizer
