"""Checkpoints: one safetensors file whose header carries the JSON facts. Nothing is ever unpickled.

The file holds the model's parameters and buffers and, for resuming, the optimiser's state, in flat names:
``model/...``, ``average/...`` (the averaged weights), ``optimizer/<parameter>/<key>``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from dmotion_bench.errors import RunCorrupt, RunMissing
from dmotion_bench.storage.atomic import write_atomically

FACTS = "dmbench"


def save(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write a checkpoint in one step: it is whole or not there."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_atomically(path, safetensors.torch.save(plain, metadata={FACTS: json.dumps(facts)}))


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and facts of a checkpoint.

    Raises:
        RunMissing: There is no such file.
        RunCorrupt: It is cut short, or no checkpoint.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as opened:
            facts = json.loads((opened.metadata() or {}).get(FACTS, "{}"))
            return {name: opened.get_tensor(name) for name in opened.keys()}, facts  # noqa: SIM118 (no mapping)
    except FileNotFoundError:
        raise RunMissing(f"no checkpoint {str(path)!r}; the run has not been trained yet.") from None
    except (safetensors.SafetensorError, json.JSONDecodeError, OSError) as error:
        raise RunCorrupt(
            f"the checkpoint {str(path)!r} cannot be read ({error}); delete it, and the 'dmbench train' command that "
            "wrote it begins anew."
        ) from error


def with_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors under ``prefix/name``."""
    return {f"{prefix}/{name}": tensor for name, tensor in tensors.items()}


def without_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Those tensors that stand under ``prefix/``, by the rest of their names."""
    return {name[len(prefix) + 1 :]: tensor for name, tensor in tensors.items() if name.startswith(f"{prefix}/")}


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """An optimiser's state as tensors with flat names (numbers among it become tensors)."""
    state = optimizer.state_dict()["state"]
    return {
        f"optimizer/{parameter}/{key}": torch.as_tensor(value)
        for parameter, values in state.items()
        for key, value in values.items()
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Put back what ``optimizer_tensors`` took."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in without_prefix("optimizer", tensors).items():
        parameter, _, key = name.partition("/")
        state.setdefault(int(parameter), {})[key] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    for weights, kept in optimizer.state.items():  # in the weights' memory order, which fused steps rely on
        for key, value in kept.items():
            if torch.is_tensor(value) and value.shape == weights.shape:
                kept[key] = torch.empty_like(weights, dtype=value.dtype).copy_(value)


def weights_hash(tensors: Mapping[str, Tensor]) -> str:
    """sha256 over names, shapes, types and values: the same for the same weights, wherever they lie."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
