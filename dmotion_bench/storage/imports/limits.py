"""How much a foreign file may make us read, inflate or hold: files from elsewhere are not trusted."""

from __future__ import annotations

from dataclasses import dataclass

MIB = 1 << 20


@dataclass(frozen=True, kw_only=True)
class ImportLimits:
    """Every declared size is held against these before anything is read or allocated.

    Attributes:
        chunk_bytes: What one MCAP chunk may inflate to. Chunks are inflated as a stream, so this bounds
            time, not memory.
        message_bytes: One message; the only piece of a file that is held whole.
        schema_bytes: One schema, and a quarter of all schemas and channels of a file together.
        pixels: Of one picture, before it is decoded.
        frames: Of all episodes together, after resampling.
        actions: Distinct actions; more than this is a measurement, not a choice.
        numbers: In the continuous actions of a recording, all together.
        reader_bytes: Memory of the process that reads videos, HDF5 and LeRobot data sets.
        reader_seconds: Of its processor, without another picture.
    """

    chunk_bytes: int = 1024 * MIB
    message_bytes: int = 256 * MIB
    schema_bytes: int = 4 * MIB
    pixels: int = 64 * MIB
    frames: int = 20_000_000
    actions: int = 64
    numbers: int = 20_000_000
    reader_bytes: int = 1024 * MIB
    reader_seconds: int = 60
