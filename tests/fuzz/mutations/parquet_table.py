"""Parquet: the table written anew with other columns, types, nulls, rows, encodings; or the file's bytes."""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.plain import spoil_bytes

NUMBERS = (0, 1, -1, 2, 5, 100, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 10**12, 2**62, 2**63 - 1, -(2**63))
WORDS = ("", "train", "test", "terminated", "model", "prediction", "x" * 100_000, "\x00", "\x1b[2J", "é", "../..")
LARGEST = 50_000  # rows of a table that is spoilt once more
BOMB_ROWS = (1_000_000, 3_000_000)


def spoil_parquet(rng: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """One or two changes of the table, then sometimes of the bytes."""
    try:
        table = pq.read_table(io.BytesIO(data))
    except (pa.ArrowException, OSError):
        return spoil_bytes(rng, data)
    if len(table) > LARGEST or not table.num_columns:
        return spoil_bytes(rng, data)
    told = []
    for _ in range(int(rng.choice([1, 1, 2]))):
        kind = pick(rng, KINDS)
        try:
            table = kind(rng, table)
        except (pa.ArrowException, ValueError, OverflowError):
            continue
        told.append(kind.__name__.strip("_"))
    if len(table) and rng.random() < 0.04:
        rows = int(rng.choice(BOMB_ROWS, p=[0.7, 0.3]))
        return repeated(table.slice(0, 1), rows), f"table: {', '.join(told)}, {rows} equal rows"
    try:
        written = table_bytes(rng, table)
    except (pa.ArrowException, ValueError):
        return spoil_bytes(rng, data)
    return written, f"table: {', '.join(told)}"


def table_bytes(rng: np.random.Generator, table: pa.Table) -> bytes:
    """A Parquet file of a table, in any of the ways there are to write one."""
    buffer = io.BytesIO()
    how = {
        "compression": pick(rng, ("zstd", "zstd", "snappy", "none", "gzip")),
        "use_dictionary": bool(rng.integers(2)),
        "write_page_checksum": bool(rng.integers(2)),
        "data_page_version": pick(rng, ("1.0", "2.0")),
        "row_group_size": pick(rng, (None, None, 1, 3)),
        "write_statistics": bool(rng.integers(2)),
    }
    pq.write_table(table, buffer, **how)
    return buffer.getvalue()


def repeated(row: pa.Table, rows: int) -> bytes:
    """So many equal rows in few bytes: what one page holds is written again and again."""
    buffer, piece = io.BytesIO(), 500_000
    block = pa.concat_tables([row] * 1000).combine_chunks()
    block = pa.concat_tables([block] * (piece // 1000)).combine_chunks()
    with pq.ParquetWriter(buffer, row.schema, compression="zstd", write_page_checksum=True) as writer:
        for _ in range(rows // piece):
            writer.write_table(block)
    return buffer.getvalue()


def _any(rng: np.random.Generator, table: pa.Table) -> int:
    return int(rng.integers(table.num_columns))


def _drop(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    return table.remove_column(_any(rng, table))


def _rename(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    names, place = list(table.column_names), _any(rng, table)
    names[place] = pick(rng, (names[place].upper(), "", "x" * 10_000, names[_any(rng, table)], "é"))
    return table.rename_columns(names)


def _add(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    name = pick(rng, ("new", "", table.column_names[_any(rng, table)]))
    return table.append_column(name, pa.array([pick(rng, NUMBERS)] * len(table), pa.int64()))


def _order(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    return table.select(rng.permutation(table.num_columns).tolist())  # by places: two columns may have one name


def _kind(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    """A column as another type, its values kept where they can be."""
    place, kinds = (
        _any(rng, table),
        (pa.int8(), pa.int32(), pa.uint64(), pa.float32(), pa.float64(), pa.string(), pa.bool_()),
    )
    kinds += (
        pa.large_string(),
        pa.binary(),
        pa.decimal128(30, 3),
        pa.timestamp("ns"),
        pa.dictionary(pa.int32(), pa.string()),
    )
    kind = pick(rng, kinds)
    try:
        column = table.column(place).cast(kind, safe=False)
    except pa.ArrowException:
        column = pa.nulls(len(table), kind)
    return table.set_column(place, table.column_names[place], column)


def _nested(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    place = _any(rng, table)
    values = table.column(place).to_pylist()
    inner = pick(
        rng, ([[value] for value in values], [{"a": value} for value in values], [[[value]] * 3 for value in values])
    )
    return table.set_column(place, table.column_names[place], pa.array(inner))


def _nulls(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    place = _any(rng, table)
    field = table.schema.field(place).with_nullable(True)
    values, share = table.column(place).to_pylist(), pick(rng, (0.1, 0.5, 1.0))
    return table.set_column(place, field, pa.array([None if rng.random() < share else v for v in values], field.type))


def _values(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    """One cell, or all of a column, with another value of its type."""
    place = _any(rng, table)
    field, values = table.schema.field(place), table.column(place).to_pylist()
    if not values:
        return table
    rows = range(len(values)) if rng.random() < 0.2 else [int(rng.integers(len(values)))]
    for row in rows:
        values[row] = _other(rng, field.type, values[row], values)
    return table.set_column(place, field, pa.array(values, field.type))


def _other(rng: np.random.Generator, kind: pa.DataType, value: object, values: list[object]) -> object:
    if rng.random() < 0.3:
        return pick(rng, values)
    if pa.types.is_integer(kind):
        near = [value + change for change in (1, -1, 1000)] if isinstance(value, int) else []
        top = 2 ** (kind.bit_width - 1)
        return pick(rng, [number for number in (*NUMBERS, *near) if -top <= number < top])
    if pa.types.is_floating(kind):
        return pick(rng, (0.0, -1.0, float("nan"), float("inf"), 1e30, -1e-30))
    if pa.types.is_string(kind):
        return pick(rng, WORDS)
    if pa.types.is_boolean(kind):
        return not value
    if pa.types.is_list(kind):
        return pick(rng, ([], [None], None, (value or []) * 2))
    return value


def _rows(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    """Fewer, more, or the same in another order."""
    if not len(table):
        return table
    one, kind = (
        int(rng.integers(len(table))),
        pick(rng, ("none", "first", "drop", "twice", "shuffle", "reverse", "many")),
    )
    if kind == "many":
        return pa.concat_tables([table] * (20_000 // len(table) + 1))
    index = np.arange(len(table))
    chosen = {
        "none": index[:0],
        "first": index[:1],
        "drop": np.delete(index, one),
        "twice": np.append(index, one),
        "shuffle": rng.permutation(index),
        "reverse": index[::-1],
    }[kind]
    return table.take(chosen)


def _metadata(rng: np.random.Generator, table: pa.Table) -> pa.Table:
    return table.replace_schema_metadata({b"ARROW:schema": rng.bytes(40), b"pandas": b"{" * 2000})


KINDS = (
    (_values,) * 5 + (_nulls,) * 2 + (_kind,) * 2 + (_rows,) * 2 + (_drop, _rename, _add, _order, _nested, _metadata)
)
