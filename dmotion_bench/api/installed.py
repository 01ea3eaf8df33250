"""What the installed models are, and how this machine computes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Supervision

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
        DmbenchError: It cannot be loaded.
    """
    kind = model_class(name)
    inputs = ModelInputs(height=_SIDE, width=_SIDE, actions=Discrete.numbered(_ACTIONS))
    built = kind(kind.configure(kind.architectures[0]), inputs)
    return ModelFacts(
        learns_from=LEARNS_FROM[kind.supervision],
        parameters=sum(parameter.numel() for parameter in built.parameters()),
        architectures=tuple(kind.architectures),
        paper=kind.paper,
    )


def bf16_on_cpu() -> bool:
    """Whether this processor computes fast with bfloat16 numbers."""
    return has_bf16(torch.device("cpu"))
