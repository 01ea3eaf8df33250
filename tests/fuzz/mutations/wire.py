"""Protobuf's wire format: fields changed, dropped, doubled, of another kind, at any depth; no schema is needed."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.plain import TELLING, spoil_bytes

VARINT, EIGHT, LENGTH, FOUR = 0, 1, 2, 5


class Field(NamedTuple):
    """A field's number, its kind on the wire, and its value: a number or bytes."""

    number: int
    kind: int
    value: int | bytes


def spoil_wire(rng: np.random.Generator, data: bytes, depth: int = 0) -> bytes:
    """One change of a message."""
    fields = parse(data)
    if not fields or rng.random() < 0.1:
        return spoil_bytes(rng, data)[0]
    place = int(rng.integers(len(fields)))
    number, kind, value = fields[place]
    if isinstance(value, bytes) and depth < 6 and rng.random() < 0.5 and parse(value):
        fields[place] = Field(number, kind, spoil_wire(rng, value, depth + 1))
        return written(fields)
    what = pick(rng, ("value",) * 5 + ("drop", "twice", "swap", "number", "kind"))
    if what == "drop":
        del fields[place]
    elif what == "twice":
        fields += [fields[place]] * int(rng.choice([1, 2, 1000]))
    elif what == "swap":
        other = int(rng.integers(len(fields)))
        fields[place], fields[other] = fields[other], fields[place]
    elif what == "number":
        fields[place] = Field(pick(rng, (1, 2, 3, 15, 536_870_911)), kind, value)
    elif what == "kind":
        fields[place] = pick(
            rng, (Field(number, VARINT, 2**63), Field(number, LENGTH, b"\xff" * 20), Field(number, FOUR, 7))
        )
    else:
        fields[place] = Field(number, kind, _other(rng, kind, value))
    return written(fields)


def _other(rng: np.random.Generator, kind: int, value: int | bytes) -> int | bytes:
    if isinstance(value, int):
        near = (value + 1, value * 2, value // 2, 0)
        if kind == EIGHT:  # most are doubles
            return struct.unpack("<Q", struct.pack("<d", pick(rng, (0.0, float("nan"), float("inf"), -1.0, 1e300))))[0]
        return pick(rng, (*TELLING, *near)) & ((1 << 32) - 1 if kind == FOUR else (1 << 64) - 1)
    return pick(
        rng,
        (
            b"",
            value[:-1],
            value + b"\0",
            value * 2,
            b"rgb8",
            b"mono16",
            b"x" * 100_000,
            b"\xff\xfe",
            b"\x1b[2J",
            b"16UC1",
            b"{}",
        ),
    )


def parse(data: bytes) -> list[Field]:
    """The fields of a message; none where it is no message."""
    fields, position = [], 0
    while position < len(data):
        tag, position = _varint(data, position)
        number, kind = tag >> 3, tag & 7
        if position < 0 or not number:
            return []
        if kind == VARINT:
            value, position = _varint(data, position)
            if position < 0:
                return []
            fields.append(Field(number, kind, value))
        elif kind in (EIGHT, FOUR):
            size = 8 if kind == EIGHT else 4
            if position + size > len(data):
                return []
            fields.append(Field(number, kind, int.from_bytes(data[position : position + size], "little")))
            position += size
        elif kind == LENGTH:
            size, position = _varint(data, position)
            if position < 0 or position + size > len(data):
                return []
            fields.append(Field(number, kind, data[position : position + size]))
            position += size
        else:
            return []
    return fields


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while position < len(data) and shift < 70:
        byte = data[position]
        value |= (byte & 127) << shift
        position, shift = position + 1, shift + 7
        if byte < 128:
            return value & (2**64 - 1), position
    return 0, -1


def written(fields: list[Field]) -> bytes:
    """The message of some fields."""
    out = bytearray()
    for number, kind, value in fields:
        out += _as_varint(number << 3 | kind)
        if isinstance(value, bytes):
            out += _as_varint(len(value)) + value
        elif kind == VARINT:
            out += _as_varint(value)
        else:
            out += value.to_bytes(8 if kind == EIGHT else 4, "little")
    return bytes(out)


def _as_varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
