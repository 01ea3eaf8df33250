"""In which precision a training multiplies matrices: bf16 or float32, whichever is faster on the hardware at hand.

bf16 is the faster one on most processors that have it, but not on all of them. So a training that is not told which
one to take measures it: a copy of its model takes some steps in each precision, in turn, before the first real step.
Neither the model nor the optimiser nor any random number is touched, so what follows is what would have followed if
the precision had been named. What was chosen and measured stands in ``run.json`` and is kept when the run goes on.
"""

from __future__ import annotations

import contextlib
from typing import Final, Literal, get_args

import torch

Precision = Literal["bf16", "float32"]
AUTO: Final = "auto"
PRECISIONS: Final[tuple[Precision, ...]] = get_args(Precision)
CHOICES: Final = (AUTO, *PRECISIONS)

FEWEST_STEPS: Final = 200
"""A shorter training is over before a measurement would have paid."""


def settled(asked: str, steps: int, device: torch.device) -> Precision | None:
    """The precision of a training, where nothing has to be measured; else None.

    Args:
        asked: One of ``CHOICES``.
        steps: Of the training.
        device: Where it runs.
    """
    if asked == "float32" or not has_bf16(device):
        return "float32"
    return "bf16" if asked == "bf16" or steps < FEWEST_STEPS else None


def may_use_bf16(asked: str) -> bool:
    """Whether a training computes in bfloat16 on any device of this machine, or measures whether it should.

    Args:
        asked: One of ``CHOICES``.
    """
    kinds = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    return any(settled(asked, FEWEST_STEPS, torch.device(kind)) != "float32" for kind in kinds)


def has_bf16(device: torch.device) -> bool:
    """Whether the hardware multiplies bfloat16 matrices by itself; emulated, it is slower than float32."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities() if device.type == "cpu" and hasattr(torch.cpu, "get_capabilities") else {}
    return bool(able.get("avx512_bf16") or able.get("amx_bf16"))


def autocast(precision: str, device: torch.device) -> contextlib.AbstractContextManager[None]:
    """bfloat16 for matrix products in ``"bf16"``; where the hardware lacks it, slowly."""
    if precision == "bf16":
        context: contextlib.AbstractContextManager[None] = torch.autocast(device.type, torch.bfloat16)
        return context
    return contextlib.nullcontext()
