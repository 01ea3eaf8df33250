"""All frames of a data set, decoded once into an Arrow file that is memory-mapped.

Random triplets straight out of MCAP come at about 1,000 a second, out of this file at 100,000 (facts.md, 5).
The file is derived: it is named after the data set's fingerprint, made anew when that changes, and safe to
delete. It is one record batch with one column ``frame``, so any Arrow reader opens it.
"""

from __future__ import annotations

import io
import mmap
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import pyarrow as pa
from jaxtyping import Int, UInt8

from dmotion_bench.storage.atomic import atomic_file

_FINGERPRINT: Final = b"dmbench.fingerprint"


@dataclass(frozen=True)
class FrameCache:
    """The frames of a data set, mapped into memory, read-only.

    Attributes:
        frames: All episodes one after the other.
        offsets: Episode e is ``frames[offsets[e]:offsets[e + 1]]``.
    """

    frames: UInt8[np.ndarray, "n h w 3"]
    offsets: Int[np.ndarray, " o"]  # o = e + 1

    def episode(self, episode: int) -> UInt8[np.ndarray, "t h w 3"]:
        """One episode's frames, not copied."""
        return self.frames[self.offsets[episode] : self.offsets[episode + 1]]


def cache_path(folder: Path, fingerprint: str) -> Path:
    """Where the cache of a data set with this fingerprint is."""
    return folder / f"frames-{fingerprint[:16]}.arrow"


def open_cache(
    folder: Path, fingerprint: str, lengths: Int[np.ndarray, " e"], height: int, width: int
) -> FrameCache | None:
    """Map the cache; None when it is not there, or is that of something else."""
    path, count = cache_path(folder, fingerprint), int(lengths.sum())
    if not path.is_file():
        return None
    try:
        batch = pa.ipc.open_file(pa.memory_map(str(path))).get_batch(0)
        column, metadata = batch.column(0), batch.schema.metadata or {}
    except (pa.ArrowException, OSError, IndexError):
        return None
    if (
        metadata.get(_FINGERPRINT) != fingerprint.encode()
        or column.type != pa.binary(height * width * 3)
        or len(column) != count
        or column.null_count
    ):
        return None
    frames = np.frombuffer(column.buffers()[1], np.uint8)[: count * height * width * 3]
    return FrameCache(frames.reshape(count, height, width, 3), np.concatenate([[0], np.cumsum(lengths)]))


def build_cache(
    folder: Path,
    fingerprint: str,
    episodes: Iterable[UInt8[np.ndarray, "t h w 3"]],
    count: int,
    height: int,
    width: int,
) -> None:
    """Write the cache, an episode in memory at a time, and remove those of earlier states of the data set.

    Args:
        folder: Where the caches are.
        fingerprint: The data set's.
        episodes: The frames of every episode, in order.
        count: How many frames they have together.
        height, width: Of a frame [px].
    """
    path = cache_path(folder, fingerprint)
    schema = pa.schema([pa.field("frame", pa.binary(height * width * 3), False)]).with_metadata(
        {_FINGERPRINT: fingerprint}
    )
    with atomic_file(path) as file:
        start = _write_frame_of_file(file, schema, count * height * width * 3)
        file.seek(start)
        for frames in episodes:
            file.write(frames.data)
        written = file.tell() - start
        if written != count * height * width * 3:
            raise ValueError(f"{written} bytes of frames were given, not {count * height * width * 3}")
    for other in folder.glob("frames-*.arrow"):
        if other != path:
            other.unlink(missing_ok=True)


class _Holes(io.RawIOBase):
    """Passes bytes on to a file, but skips one buffer's, which becomes a hole."""

    def __init__(self, file: BinaryIO, skipped: pa.Buffer) -> None:
        super().__init__()
        self._file, self._address = file, skipped.address
        self.start = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        if isinstance(data, pa.Buffer) and data.address == self._address:
            self.start = self._file.tell()
            self._file.seek(data.size, os.SEEK_CUR)
            return int(data.size)
        return self._file.write(data)


def _write_frame_of_file(file: BinaryIO, schema: pa.Schema, size: int) -> int:
    """Write an Arrow file of one batch whose column is a hole of ``size`` bytes; where the hole starts.

    Arrow writes a batch from memory alone. It is given memory that is reserved, read-only and never touched,
    and what it writes of it is skipped in the file: neither memory nor time is spent on the zeros.
    """
    kind = schema.field(0).type
    reserved = mmap.mmap(-1, max(size, 1), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ)
    zeros = pa.py_buffer(reserved)
    column = pa.FixedSizeBinaryArray.from_buffers(kind, size // kind.byte_width, [None, zeros])
    sink = _Holes(file, zeros)
    with pa.PythonFile(sink, "w") as stream, pa.ipc.new_file(stream, schema) as writer:
        writer.write_batch(pa.record_batch([column], schema=schema))
    return sink.start
