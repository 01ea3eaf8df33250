"""Arrow IPC: the batch with another type, other rows, nulls or metadata, or several; or the file's bytes."""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.plain import spoil_bytes


def spoil_arrow(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """One change of the table, of the values, or of the bytes."""
    if rng.random() < 0.5:
        return _spoil_values(rng, data)
    try:
        batch = pa.ipc.open_file(pa.BufferReader(data)).get_batch(0)
    except (pa.ArrowException, OSError):
        return spoil_bytes(rng, data)
    kind = pick(rng, ("rows", "name", "type", "nulls", "metadata", "two", "none", "order", "column"))
    schema, column = batch.schema, batch.column(0)
    batches = [batch]
    if kind == "rows":
        batches = [batch.slice(0, int(rng.integers(len(batch) + 1)))]
    elif kind == "two":
        batches = [batch.slice(0, 2), batch.slice(2)]
    elif kind == "none":
        batches = []
    elif kind == "order":
        batches = [batch.take(pa.array(rng.permutation(len(batch))))]
    elif kind == "name":
        batches = [
            pa.record_batch([column], schema=pa.schema([pa.field("other", column.type, False)], schema.metadata))
        ]
    elif kind == "type":
        other = pick(rng, (pa.binary(), pa.large_binary(), pa.list_(pa.uint8())))
        values = [list(value) if other == pa.list_(pa.uint8()) else value for value in column.to_pylist()]
        batches = [
            pa.record_batch([pa.array(values, other)], schema=pa.schema([pa.field("frame", other)], schema.metadata))
        ]
    elif kind == "nulls":
        values = column.to_pylist()
        values[int(rng.integers(len(values)))] = None
        changed = pa.schema([pa.field("frame", column.type)], schema.metadata)
        batches = [pa.record_batch([pa.array(values, column.type)], schema=changed)]
    elif kind == "metadata":
        metadata = {
            name: pick(rng, (b"", b"0" * 64, value.upper(), value + b"x"))
            for name, value in (schema.metadata or {}).items()
        }
        batches = [batch.replace_schema_metadata(metadata)]
    else:
        more = pa.schema([*schema, pa.field("more", pa.int64())], schema.metadata)
        batches = [pa.record_batch([column, pa.array([0] * len(batch))], schema=more)]
    buffer = io.BytesIO()
    with pa.ipc.new_file(buffer, (batches[0] if batches else batch).schema) as writer:
        for one in batches:
            writer.write_batch(one)
    return buffer.getvalue(), f"arrow: {kind}"


def _spoil_values(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """Pixels alone: the file stays what it was in every other respect."""
    changed = bytearray(data)
    low, high = len(data) // 4, max(len(data) // 4 + 1, len(data) * 3 // 4)
    for _ in range(int(rng.choice([1, 1, 16, 2000]))):
        changed[int(rng.integers(low, high))] ^= 1 << int(rng.integers(8))
    return bytes(changed), "arrow: bits of the values"
