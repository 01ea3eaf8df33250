"""What the installed models are, and how this machine computes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch.nn.parameter import is_lazy

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.learning.model import ForwardModel, ModelInputs
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Supervision
from dmotion_bench.wording import shown

_SIDE, _ACTIONS = 128, 4
LEARNS_FROM: Final = {
    Supervision.NONE: "video",
    Supervision.FEW: "video, few actions",
    Supervision.ACTIONS: "video and actions",
}


@dataclass(frozen=True, kw_only=True)
class ModelFacts:
    """A model, as ``dmbench list models`` shows it.

    Attributes:
        learns_from: ``"video"``, ``"video, few actions"``, or ``"video and actions"``.
        parameters: Of its first architecture, for 128 x 128 pixels and four actions.
        architectures: Their names.
        paper: Where it is from.
    """

    learns_from: str
    parameters: int
    architectures: tuple[str, ...]
    paper: str


def model_facts(name: str) -> ModelFacts:
    """What a model is.

    Args:
        name: Its registered name.

    Raises:
        UnknownName: There is none of this name.
        DmbenchError: It cannot be loaded, or is no class of models.
        ModelContractBroken: Its weights have no shape before the first batch.
    """
    kind = model_class(name)
    if not (isinstance(kind, type) and issubclass(kind, ForwardModel)):
        raise ModelContractBroken(f"{shown(kind)} is no subclass of dmotion_bench.learning.model.ForwardModel.")
    inputs = ModelInputs(height=_SIDE, width=_SIDE, actions=Discrete.numbered(_ACTIONS))
    built = kind(kind.configure(kind.architectures[0]), inputs)
    if any(is_lazy(parameter) for parameter in built.parameters()):
        raise ModelContractBroken(
            f"{kind.__qualname__} has weights without a shape before the first batch, as lazy modules have; give its "
            "layers all their sizes."
        )
    return ModelFacts(
        learns_from=LEARNS_FROM[kind.supervision],
        parameters=sum(parameter.numel() for parameter in built.parameters()),
        architectures=tuple(kind.architectures),
        paper=kind.paper,
    )


def bf16_on_cpu() -> bool:
    """Whether this processor computes fast with bfloat16 numbers."""
    return has_bf16(torch.device("cpu"))
