"""safetensors: the header's facts, names, types, shapes and places of tensors, and their values."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.json_text import HOSTILE, spoil_json, written
from tests.fuzz.mutations.plain import TELLING, spoil_bytes

SIZES = {
    "F64": 8,
    "I64": 8,
    "F32": 4,
    "I32": 4,
    "F16": 2,
    "BF16": 2,
    "I16": 2,
    "U8": 1,
    "I8": 1,
    "BOOL": 1,
    "F8_E4M3": 1,
}


def spoil_weights(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """One change of the header or of a tensor."""
    try:
        (length,) = struct.unpack_from("<Q", data)
        header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    except (struct.error, ValueError, RecursionError):
        return spoil_bytes(rng, data)
    kind = pick(rng, KINDS)
    return kind(rng, header, body)


def packed(header: dict[str, Any], body: bytes) -> bytes:
    """A file of a header and what follows it."""
    text = written(header).encode("utf-8", "surrogatepass")
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + body


def _names(header: dict[str, Any]) -> list[str]:
    return [name for name in header if name != "__metadata__"]


def _facts(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    """What dmbench keeps as JSON in the metadata."""
    metadata = header.get("__metadata__") or {}
    if not metadata:
        return _header(rng, header, body)
    name = pick(rng, list(metadata))
    told = "are gone"
    if rng.random() < 0.15:
        del metadata[name]
    else:
        text, told = spoil_json(rng, metadata[name].encode())
        metadata[name] = text.decode("utf-8", "replace")
    return packed(header, body), f"facts {name}: {told}"


def _header(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    """The header as any JSON."""
    text, told = spoil_json(rng, json.dumps(header).encode())
    return struct.pack("<Q", len(text)) + text + body, f"header: {told}"


def _length(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    text = json.dumps(header).encode()
    length = pick(rng, (*TELLING, len(text) + 1, len(text) - 1, len(text) + len(body)))
    return struct.pack("<Q", length) + text + body, f"header of {length} bytes"


def _rename(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    old = pick(rng, _names(header))
    prefix, _, rest = old.partition("/")
    other = pick(rng, _names(header))
    new = pick(
        rng, (f"{old}x", rest, f"optimizer/{rest}", f"optimizer/x/{rest}", f"optimizer/999999/{rest}", f"{prefix}/")
    )
    new = pick(
        rng, (new, new, f"average/{rest}", f"hardness/{rest}", f"model/{rest}", "", "optimizer/0/exp_avg", other)
    )
    changed = {new if name == old else name: value for name, value in header.items()}
    return packed(changed, body), f"{old} is called {new}"


def _drop(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    """Without one tensor, or without all of a kind; what is left is moved together."""
    prefix = pick(rng, _names(header))
    prefix = prefix.partition("/")[0] if rng.random() < 0.4 else prefix
    kept = {name: value for name, value in header.items() if not name.startswith(prefix)}
    return _moved(kept, body), f"without {prefix}"


def _moved(header: dict[str, Any], body: bytes) -> bytes:
    parts, place, header = [], 0, dict(header)
    for name in _names(header):
        start, stop = header[name]["data_offsets"]
        parts.append(body[start:stop])
        header[name] = header[name] | {"data_offsets": [place, place + stop - start]}
        place += stop - start
    return packed(header, b"".join(parts))


def _add(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    name = pick(
        rng,
        (
            "model/new",
            "optimizer/0/new",
            "optimizer/7/exp_avg",
            "average/new",
            "hardness/x",
            "new",
            "model/",
            "optimizer/",
        ),
    )
    size = int(rng.choice([0, 4, 64]))
    header[name] = {"dtype": "F32", "shape": [size // 4], "data_offsets": [len(body), len(body) + size]}
    return packed(header, body + bytes(size)), f"{name} is new"


def _shape(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    """The same bytes as another type or shape."""
    name = pick(rng, _names(header))
    tensor = header[name]
    size = tensor["data_offsets"][1] - tensor["data_offsets"][0]
    if rng.random() < 0.5:
        tensor["dtype"] = pick(rng, list(SIZES))
    count = size // SIZES.get(tensor["dtype"], 4)
    tensor["shape"] = pick(
        rng,
        (
            [count],
            [1, count],
            [count, 1],
            [count, 1, 1],
            tensor["shape"][::-1],
            [2, count // 2],
            [],
            [0],
            [count, 0, 2**40],
            [2**32, 2**32],
            [-1],
        ),
    )
    return packed(header, body), f"{name} is {tensor['dtype']} {tensor['shape']}"


def _place(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    name = pick(rng, _names(header))
    header[name]["data_offsets"] = [pick(rng, (0, len(body), 2**63, -1)), pick(rng, (0, 4, len(body), 2**64 - 1))]
    return packed(header, body), f"{name} is somewhere else"


def _values(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    """A tensor's values: one bit, or all of them not finite, huge or zero."""
    name = pick(rng, _names(header))
    start, stop = header[name]["data_offsets"]
    data = bytearray(body)
    if stop > start:
        what = pick(rng, ("bit", "bit", "bit", "nan", "inf", "huge", "zero", "swap"))
        if what == "bit":
            data[int(rng.integers(start, stop))] ^= 1 << int(rng.integers(8))
        elif what == "swap":
            other = header[pick(rng, _names(header))]["data_offsets"]
            size = min(stop - start, other[1] - other[0])
            data[start : start + size] = body[other[0] : other[0] + size]
        else:
            pattern = {
                "nan": b"\x00\x00\xc0\x7f",
                "inf": b"\x00\x00\x80\x7f",
                "huge": b"\xff\xff\x7f\x7f",
                "zero": bytes(4),
            }[what]
            data[start:stop] = (pattern * (stop - start))[: stop - start]
    else:
        what = "nothing"
    return packed(header, bytes(data)), f"{name}: {what}"


def _metadata(rng: np.random.Generator, header: dict[str, Any], body: bytes) -> tuple[bytes, str]:
    header["__metadata__"] = pick(rng, (*HOSTILE, {"dmbench": "null"}, {"dmbench": "[]"}, {"dmbench": "{}"}))
    return packed(header, body), "other metadata"


KINDS = (
    (_facts,) * 4 + (_values,) * 4 + (_rename,) * 2 + (_shape,) * 2 + (_drop, _add, _header, _length, _place, _metadata)
)
