"""Bytes without any structure: flipped, overwritten, cut, copied, moved, zeroed."""

from __future__ import annotations

import struct

import numpy as np

from tests.fuzz.mutations import pick

TELLING = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
"""Numbers at which lengths and counts go wrong."""


def spoil_bytes(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """One to three plain mutations."""
    told = []
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        kind = pick(rng, KINDS)
        data = kind(rng, bytearray(data))
        told.append(kind.__name__.strip("_"))
    return data, f"bytes: {', '.join(told)}"


def _flip(rng: np.random.Generator, data: bytearray) -> bytes:
    for _ in range(int(rng.choice([1, 1, 1, 4, 16]))):
        if data:
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _overwrite(rng: np.random.Generator, data: bytearray) -> bytes:
    """A whole number that tells, little or big endian, somewhere."""
    size = int(rng.choice([1, 2, 4, 8]))
    if len(data) >= size:
        number = pick(rng, TELLING) & (2 ** (8 * size) - 1)
        order = pick(rng, "<>")
        at = int(rng.integers(len(data) - size + 1))
        data[at : at + size] = struct.pack(order + {1: "B", 2: "H", 4: "I", 8: "Q"}[size], number)
    return bytes(data)


def _truncate(rng: np.random.Generator, data: bytearray) -> bytes:
    near_end = bool(rng.integers(2))
    length = len(data) - int(rng.integers(1, 64)) if near_end else int(rng.integers(len(data) + 1))
    return bytes(data[: max(length, 0)])


def _extend(rng: np.random.Generator, data: bytearray) -> bytes:
    return bytes(data) + rng.bytes(int(rng.choice([1, 7, 4096])))


def _zero(rng: np.random.Generator, data: bytearray) -> bytes:
    start, stop = _range(rng, len(data))
    data[start:stop] = bytes(stop - start)
    return bytes(data)


def _garble(rng: np.random.Generator, data: bytearray) -> bytes:
    start, stop = _range(rng, len(data))
    data[start:stop] = rng.bytes(stop - start)
    return bytes(data)


def _remove(rng: np.random.Generator, data: bytearray) -> bytes:
    start, stop = _range(rng, len(data))
    del data[start:stop]
    return bytes(data)


def _repeat(rng: np.random.Generator, data: bytearray) -> bytes:
    start, stop = _range(rng, len(data))
    return bytes(data[:stop] + data[start:stop] * int(rng.choice([1, 3])) + data[stop:])


def _splice(rng: np.random.Generator, data: bytearray) -> bytes:
    """A piece of the file over another place in it."""
    start, stop = _range(rng, len(data))
    at = int(rng.integers(len(data) + 1))
    data[at : at + stop - start] = data[start:stop]
    return bytes(data)


def _empty(_rng: np.random.Generator, _data: bytearray) -> bytes:
    return b""


def _range(rng: np.random.Generator, length: int) -> tuple[int, int]:
    start = int(rng.integers(length + 1))
    size = int(rng.choice([1, 2, 4, 8, 32, 256, 4096]))
    return start, min(start + size, length)


KINDS = (
    (_flip,) * 4
    + (_overwrite,) * 4
    + (_truncate, _truncate, _extend, _zero, _garble, _remove, _repeat, _splice, _empty)
)
