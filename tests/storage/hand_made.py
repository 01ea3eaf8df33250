"""MCAP files whose records no writer would write, and the sentence that refuses them."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from storage.foreign import (
    START,
)

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions

SMALL = ImportOptions(size=32)
MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, body: bytes, declared: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if declared is None else declared) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(stored: bytes, declared: int, crc: int = 0, compression: str = "zstd") -> bytes:
    head = struct.pack("<QQQI", START, START, declared, crc) + text(compression)
    return record(0x06, head + struct.pack("<Q", len(stored)) + stored)


def by_hand(path: Path, *records: bytes) -> Path:
    """A file whose records no writer would write: a camera's channel, then these."""
    schema = struct.pack("<H", 1) + text("foxglove.RawImage") + text("protobuf") + struct.pack("<I", 0)
    channel = struct.pack("<HH", 1, 1) + text("/camera") + text("protobuf") + struct.pack("<I", 0)
    footer = record(0x02, struct.pack("<QQI", 0, 0, 0))
    parts = [MAGIC, record(0x01, text("") + text("")), record(0x03, schema), record(0x04, channel), *records]
    path.write_bytes(b"".join([*parts, record(0x0F, struct.pack("<I", 0)), footer, MAGIC]))
    return path


def refused(paths: Path | list[Path], folder: Path, match: str, options: ImportOptions = SMALL) -> str:
    """The import fails with this sentence and leaves nothing behind."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(RecordingImportError, match=match) as caught:
        import_recordings([paths] if isinstance(paths, Path) else paths, folder / "out", options)
    assert sorted(folder.rglob("*")) == before
    return str(caught.value)


def peak_of(run: Callable[[], object]) -> int:
    """The most memory that Python and numpy held while it ran [bytes]."""
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
