"""Messages between the import and the process in which it reads: a head in JSON, and perhaps bytes."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from io import BufferedIOBase
from typing import IO, Any, Final

from dmotion_bench.storage.imports.limits import MIB

_LENGTHS: Final = struct.Struct("<IQ")
_LONGEST_HEAD: Final = 256 * MIB


class Hungup(Exception):
    """The other end is gone, or says what no end says."""


def send(pipe: IO[bytes], head: Mapping[str, Any], body: bytes | memoryview = b"") -> None:
    """Write a message."""
    text = json.dumps(head).encode()
    pipe.write(_LENGTHS.pack(len(text), len(body)))
    pipe.write(text)
    pipe.write(body)
    pipe.flush()


def receive(pipe: IO[bytes], *, most: int) -> tuple[dict[str, Any], bytearray]:
    """Read a message with at most so many bytes beside its head.

    Raises:
        Hungup: There is none.
    """
    text_length, length = _LENGTHS.unpack(_exactly(pipe, _LENGTHS.size))
    if text_length > _LONGEST_HEAD or length > most:
        raise Hungup
    head = json.loads(_exactly(pipe, text_length))
    return head, _exactly(pipe, length)


def _exactly(pipe: IO[bytes], size: int) -> bytearray:
    assert isinstance(pipe, BufferedIOBase)
    data = bytearray(size)
    view, have = memoryview(data), 0
    while have < size:
        read = pipe.readinto(view[have:])
        if not read:
            raise Hungup
        have += read
    return data
