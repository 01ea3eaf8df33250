"""Checkpoints: one safetensors file whose header carries the JSON facts and a checksum. Nothing is ever unpickled.

The file holds the model's parameters and buffers and, for resuming, the optimiser's state, in flat names:
``model/...``, ``average/...`` (the averaged weights), ``optimizer/<parameter>/<key>``.

The checksum, which stands among the facts, is a SHA-256 over names, types, shapes and values of all tensors and over
the other facts. A file without one was written by an earlier version and is read all the same. The weights of a
finished run of that version are held against the hash in ``run.json``; nothing can show a flipped bit in the
checkpoints of an unfinished one.
"""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from dmotion_bench.errors import RunCorrupt, RunError, RunMissing
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.json_file import parse_json
from dmotion_bench.wording import shown

FACTS: Final = "dmbench"
CHECKSUM: Final = "sha256"
LARGEST_WEIGHTS: Final = 2**34  # bytes of a file whose tensors are not known beforehand
LARGEST_FACTS: Final = 2**16  # characters
_TOLD: Final = 3  # differences that a sentence names


@dataclass(frozen=True)
class Form:
    """The type of a tensor, as safetensors names it, and its shape."""

    dtype: str
    shape: tuple[int, ...]

    @classmethod
    def of(cls, tensor: Tensor) -> Form:
        """The form of a tensor, which may lie on the meta device."""
        return cls(_NAMES[tensor.dtype], tuple(tensor.shape))

    def __str__(self) -> str:
        return f"{self.dtype} {list(self.shape)}"


Forms = Mapping[str, Form]
_NAMES: Final = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.float16: "F16",
    torch.bfloat16: "BF16",
    torch.complex64: "C64",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
    torch.uint16: "U16",
    torch.uint32: "U32",
    torch.uint64: "U64",
    torch.bool: "BOOL",
}


def forms_of(tensors: Mapping[str, Tensor]) -> dict[str, Form]:
    """The form of each tensor."""
    return {name: Form.of(tensor) for name, tensor in tensors.items()}


def save(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write a checkpoint in one step, so that it is complete or absent.

    Tensors that share memory, such as tied weights, are written each under its own name. Read back into the model, they
    share memory again.
    """
    plain = _apart({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})
    told = json.dumps({**facts, CHECKSUM: _checksum(plain, facts)}, allow_nan=False)
    write_atomically(path, safetensors.torch.save(plain, metadata={FACTS: told}))


def _apart(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors, each in memory of its own, as safetensors asks."""
    taken = set[int]()
    apart = {}
    for name, tensor in tensors.items():
        place = tensor.untyped_storage().data_ptr()
        apart[name] = tensor.clone() if place in taken else tensor
        taken.add(place)
    return apart


def load(
    path: Path, *, required: Forms | None = None, optional: Forms | None = None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and facts of a checkpoint.

    Args:
        path: The file.
        required: Tensors that must be there. The file's header is held against them before any tensor is read, so that
            no more memory is taken than they need. If left out, whatever the file holds is read.
        optional: Tensors that may be there as well.

    Raises:
        RunMissing: There is no such file.
        RunCorrupt: It is cut short or changed, it is no checkpoint, or it holds other tensors.
        RunError: The file may not be opened.
    """
    while True:  # safetensors opens the file twice, and a training that goes on may put another one there in between
        there = identity(path)
        try:
            return _load(path, required, optional or {})
        except RunCorrupt:
            if identity(path) == there:
                raise


def identity(path: Path) -> tuple[int, int] | None:
    """Tells a file from one that takes its place; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _load(path: Path, required: Forms | None, optional: Forms) -> tuple[dict[str, Tensor], dict[str, Any]]:
    _require_readable(path)
    try:
        with safetensors.safe_open(path, framework="pt") as opened:
            found = _header(opened)
            _require_forms(path, found, required, optional)
            facts = parse_json((opened.metadata() or {}).get(FACTS, "null"), largest=LARGEST_FACTS)
            tensors = {name: opened.get_tensor(name) for name in found}
    except (safetensors.SafetensorError, ValueError, OSError) as error:
        raise damaged(path, f"cannot be read: {error}") from None
    checksum = facts.pop(CHECKSUM, None)
    if checksum is not None and checksum != _checksum(tensors, facts):
        raise damaged(path, "cannot be read: its checksum is another, so it is not what was written")
    return tensors, facts


def count_tensors(path: Path) -> int:
    """How many tensors a checkpoint's header names; errors as those of ``load``."""
    _require_readable(path)
    try:
        with safetensors.safe_open(path, framework="pt") as opened:
            return len(opened.keys())
    except (safetensors.SafetensorError, OSError) as error:
        raise damaged(path, f"cannot be read: {error}") from None


def damaged(path: Path, what: str) -> RunCorrupt:
    """The error for a damaged checkpoint; ``what`` says what is wrong."""
    return RunCorrupt(
        f"the checkpoint {shown(str(path))} {what}. Delete the .safetensors files of that folder, and the "
        "'dmbench train' command that wrote them begins anew."
    )


def _require_readable(path: Path) -> None:
    """Open the file once: safetensors says of a file that it may not open that there is none."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise damaged(path, "is no ordinary file")  # a pipe would be waited for
        with path.open("rb"):
            return
    except FileNotFoundError:
        raise RunMissing(
            f"no checkpoint {shown(str(path))}: the run has not been trained yet, or the file was deleted; give the "
            "'dmbench train' command that began the run."
        ) from None
    except OSError as error:
        raise RunError(
            f"the checkpoint {shown(str(path))} is there and cannot be opened: {error.strerror}; make it readable, "
            "and give the same command again."
        ) from None


def _header(opened: Any) -> dict[str, Form]:
    found = {}
    for name in opened.keys():  # noqa: SIM118 (no mapping)
        part = opened.get_slice(name)
        found[name] = Form(part.get_dtype(), tuple(part.get_shape()))
        if found[name].dtype not in _NAMES.values():
            raise ValueError(f"the tensor {shown(name)} is of the type {found[name].dtype}, which no model has")
    return found


def _require_forms(path: Path, found: Forms, required: Forms | None, optional: Forms) -> None:
    if required is None:
        if path.stat().st_size > LARGEST_WEIGHTS:
            raise damaged(path, f"cannot be read: it is larger than {LARGEST_WEIGHTS:,} bytes")
        return
    known = {**optional, **required}
    wrong = [f"there is no {shown(name)}" for name in required if name not in found]
    wrong += [f"there is {shown(name)}" for name in found if name not in known]
    wrong += [
        f"{shown(name)} is {shown(str(form))}, not {known[name]}"
        for name, form in found.items()
        if name in known and form != known[name]
    ]
    if wrong:
        more = f" and {len(wrong) - _TOLD} more" if len(wrong) > _TOLD else ""
        raise damaged(path, f"holds other tensors than the training has: {', '.join(wrong[:_TOLD])}{more}")


def with_prefix(prefix: str, tensors: Mapping[str, Any]) -> dict[str, Any]:
    """The same tensors, or their forms, under ``prefix/name``."""
    return {f"{prefix}/{name}": tensor for name, tensor in tensors.items()}


def without_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Those tensors that stand under ``prefix/``, by the rest of their names."""
    return {name[len(prefix) + 1 :]: tensor for name, tensor in tensors.items() if name.startswith(f"{prefix}/")}


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """An optimiser's state as tensors with flat names (numbers among it become tensors)."""
    state = optimizer.state_dict()["state"]
    return {
        f"optimizer/{parameter}/{key}": state_tensor(value)
        for parameter, values in state.items()
        for key, value in values.items()
    }


def state_tensor(value: Any) -> Tensor:
    """A tensor or a number of an optimiser's state as a tensor that holds exactly this."""
    return torch.as_tensor(value, dtype=torch.float64 if isinstance(value, float) else None)


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], numbers: Collection[str] = ()
) -> None:
    """Put back what ``optimizer_tensors`` took.

    Args:
        optimizer: Of the same parameters.
        tensors: What was taken.
        numbers: The names of those that were numbers, and are to be numbers again.
    """
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in without_prefix("optimizer", tensors).items():
        parameter, _, key = name.partition("/")
        state.setdefault(int(parameter), {})[key] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    places = {id(one): place for place, one in enumerate(one for g in optimizer.param_groups for one in g["params"])}
    for weights, kept in optimizer.state.items():
        taken = state.get(places[id(weights)], {})
        for key, value in kept.items():
            if f"optimizer/{places[id(weights)]}/{key}" in numbers:
                kept[key] = taken[key].item()
            elif torch.is_tensor(value):  # torch gives it the weights' type, and not their memory order
                exact = taken[key].to(value.device) if value.dtype != taken[key].dtype else value
                alike = exact.shape == weights.shape  # fused steps rely on the order
                kept[key] = torch.empty_like(weights, dtype=exact.dtype).copy_(exact) if alike else exact


def weights_hash(tensors: Mapping[str, Tensor]) -> str:
    """sha256 over names, shapes, types and values: the same for the same weights, wherever they lie."""
    return _digest(tensors).hexdigest()


def _checksum(tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> str:
    digest = _digest(tensors)
    digest.update(json.dumps(facts, sort_keys=True).encode())
    return digest.hexdigest()


def _digest(tensors: Mapping[str, Tensor]) -> hashlib._Hash:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest
