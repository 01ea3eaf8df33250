"""Arrow IPC: the batch with another type, other rows, nulls or metadata, or several; or the file's bytes."""

from __future__ import annotations

import io
import zlib

import numpy as np
import pyarrow as pa

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.plain import spoil_bytes


def spoil_arrow(rng: np.random.Generator, data: bytes, *, mend: bool) -> tuple[bytes, str]:
    """One change of the table, of the values, or of the bytes.

    Args:
        mend: Whether the frames' checksums are made to fit them.
    """
    if rng.random() < 0.5:
        after, told = _spoil_values(rng, data)
        return (_mended(after), f"{told}, with their checksums") if mend else (after, told)
    try:
        batch = pa.ipc.open_file(pa.BufferReader(data)).get_batch(0)
    except (pa.ArrowException, OSError):
        return spoil_bytes(rng, data)
    kind = pick(rng, ("rows", "name", "type", "nulls", "metadata", "two", "none", "order", "column", "sums"))
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
        batches = [_with(batch, 0, pa.field("other", column.type, False), column)]
    elif kind == "type":
        other = pick(rng, (pa.binary(), pa.large_binary(), pa.list_(pa.uint8())))
        values = [list(value) if other == pa.list_(pa.uint8()) else value for value in column.to_pylist()]
        batches = [_with(batch, 0, pa.field("frame", other), pa.array(values, other))]
    elif kind == "nulls":
        values = column.to_pylist()
        values[int(rng.integers(len(values)))] = None
        batches = [_with(batch, 0, pa.field("frame", column.type), pa.array(values, column.type))]
    elif kind == "metadata":
        metadata = {
            name: pick(rng, (b"", b"0" * 64, value.upper(), value + b"x"))
            for name, value in (schema.metadata or {}).items()
        }
        batches = [batch.replace_schema_metadata(metadata)]
    elif kind == "sums":
        last = batch.num_columns - 1
        batches = [
            _with(batch, last, schema.field(last), batch.column(last).take(pa.array(rng.permutation(len(batch)))))
        ]
    else:
        more = pa.schema([*schema, pa.field("more", pa.int64())], schema.metadata)
        batches = [pa.record_batch([*batch.columns, pa.array([0] * len(batch))], schema=more)]
    written = _written(batches, (batches[0] if batches else batch).schema)
    return (_mended(written) if mend and kind in ("order", "two") else written), f"arrow: {kind}"


def _with(batch: pa.RecordBatch, place: int, field: pa.Field, column: pa.Array) -> pa.RecordBatch:
    """With another column in the place of one."""
    fields, columns = list(batch.schema), list(batch.columns)
    fields[place], columns[place] = field, column
    return pa.record_batch(columns, schema=pa.schema(fields, batch.schema.metadata))


def _written(batches: list[pa.RecordBatch], schema: pa.Schema) -> bytes:
    buffer = io.BytesIO()
    with pa.ipc.new_file(buffer, schema) as writer:
        for one in batches:
            writer.write_batch(one)
    return buffer.getvalue()


def _mended(data: bytes) -> bytes:
    """With the checksums that the frames have now, as ``docs/format.md`` defines them."""
    try:
        file = pa.ipc.open_file(pa.BufferReader(data))
        batches = [file.get_batch(number) for number in range(file.num_record_batches)]
        place, number = batches[0].schema.get_field_index("crc32"), 0
        for at, batch in enumerate(batches):
            frames = batch.column(0).to_pylist()
            sums = [zlib.crc32(frame, number + n) for n, frame in enumerate(frames)]
            batches[at] = _with(batch, place, batch.schema.field(place), pa.array(sums, pa.uint32()))
            number += len(frames)
        return _written(batches, batches[0].schema)
    except (pa.ArrowException, OSError, IndexError, TypeError):
        return data


def _spoil_values(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """Pixels alone: the file stays what it was in every other respect."""
    changed = bytearray(data)
    low, high = len(data) // 4, max(len(data) // 4 + 1, len(data) * 3 // 4)
    for _ in range(int(rng.choice([1, 1, 16, 2000]))):
        changed[int(rng.integers(low, high))] ^= 1 << int(rng.integers(8))
    return bytes(changed), "arrow: bits of the values"
