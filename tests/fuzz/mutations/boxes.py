"""MP4: boxes and the tables in them; WebM, MKV and AVI as plain bytes."""

from __future__ import annotations

import struct

import numpy as np

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.plain import TELLING, spoil_bytes

HOLDERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf", b"mvex", b"moof", b"traf")


def spoil_video(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """One or two changes of boxes, or of the bytes."""
    boxes = list(_walk(data, 0, len(data)))
    if len(boxes) < 4 or rng.random() < 0.25:
        return spoil_bytes(rng, data)
    told = []
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 2]))):
        start, size, kind = pick(rng, [box for box in boxes if box[2] != b"mdat"] if rng.random() < 0.85 else boxes)
        what = pick(rng, ("number",) * 6 + ("flip", "size", "kind", "zero"))
        told.append(f"{kind.decode('latin-1')} {what}")
        if what == "number" and size >= 16:  # most boxes are tables of numbers of four bytes
            at = start + 8 + 4 * int(rng.integers((size - 8) // 4))
            if at + 4 <= len(out):
                (old,) = struct.unpack_from(">I", out, at)
                new = pick(rng, (*TELLING, old + 1, old * 2, old - 1, old << 16)) & (2**32 - 1)
                struct.pack_into(">I", out, at, new)
        elif what == "size":
            struct.pack_into(
                ">I", out, start, pick(rng, (0, 1, 7, 8, size + 1, size - 1, 2**31, 2**32 - 1)) & (2**32 - 1)
            )
        elif what == "kind":
            out[start + 4 : start + 8] = pick(rng, (b"free", b"moov", b"trak", b"stbl", b"mdat", b"xxxx", b"\0\0\0\0"))
        elif what == "zero":
            out[start + 8 : start + size] = bytes(max(size - 8, 0))
        else:
            out[start + int(rng.integers(size))] ^= 1 << int(rng.integers(8))
    return bytes(out), f"boxes: {', '.join(told)}"


def _walk(data: bytes, start: int, stop: int):
    """Where each box stands, its size and its kind."""
    while start + 8 <= stop:
        size, kind = struct.unpack_from(">I4s", data, start)
        if size < 8 or start + size > stop:
            return
        yield start, size, kind
        if kind in HOLDERS:
            yield from _walk(data, start + 8, start + size)
        start += size
