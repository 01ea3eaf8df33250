"""Parquet tables out of files that may come from anybody: what they hold is known before memory is set aside for it."""

from __future__ import annotations

import os
import stat
import struct
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Final

import pyarrow as pa
import pyarrow.parquet as pq

from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.parquet_pages import Page, list_pages

_TAIL: Final = struct.Struct("<I4s")  # the footer's size, and the end of the file
_LARGEST_FOOTER: Final = 2**16  # [bytes]
_COLUMN_BYTES, _VALUE_BYTES = 4096, 24
"""More than a column takes uncompressed: at all, and for each of its values."""
_WRITER: Final = "parquet-cpp-arrow version "
_ENCODINGS: Final = {0, 2, 8}
"""Plain, and the two names of a dictionary: others make much of little."""


def largest_file(schema: pa.Schema, rows: int) -> int:
    """More bytes than a table without lists takes."""
    return _LARGEST_FOOTER + len(schema) * (_COLUMN_BYTES + rows * _VALUE_BYTES)


def read_parquet(
    path: Path,
    schema: pa.Schema,
    counts: range,
    *,
    said_by: str,
    most_listed: int = 0,
    optional: Collection[str] = (),
) -> pa.Table:
    """The table of a file, its text columns as dictionaries.

    Args:
        path: The file.
        schema: Its columns must be these, in this order.
        counts: Its number of rows must be one of these.
        said_by: The file that says so.
        most_listed: Values that a column of lists can have.
        optional: Names of columns that may be missing.

    Raises:
        DamagedFile: It is no such table; says what of it, to follow the name of the file.
    """
    try:
        _check_tail(path)
        text = [field.name for field in schema if field.type == pa.string()]
        with pq.ParquetFile(
            path,
            read_dictionary=text,
            page_checksum_verification=True,
            thrift_string_size_limit=_LARGEST_FOOTER,
            thrift_container_size_limit=_LARGEST_FOOTER,
        ) as file:
            there = file.schema_arrow.names
            schema = pa.schema([field for field in schema if field.name in there or field.name not in optional])
            _check_footer(file, schema, counts, said_by)
            _check_columns(path, file.metadata, schema, most_listed)
            return file.read(use_threads=False) if file.metadata.num_rows else schema.empty_table()
    except KeyError:  # what should be a column of text has columns of its own
        raise DamagedFile("has other columns, some within others") from None
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise DamagedFile(f"cannot be read: {error}") from None


def _check_tail(path: Path) -> None:
    """See that the footer is not larger than a footer of ours: to be parsed it takes many times its size."""
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):  # a pipe would be waited for
        raise DamagedFile("is no ordinary file")
    with path.open("rb") as file:
        file.seek(-min(_TAIL.size, about.st_size), os.SEEK_END)
        tail = file.read()
    size, end = _TAIL.unpack(tail) if len(tail) == _TAIL.size else (0, b"")
    if end != b"PAR1" or size > _LARGEST_FOOTER:
        raise DamagedFile("is no Parquet file of ours")


def _check_footer(file: pq.ParquetFile, schema: pa.Schema, counts: range, said_by: str) -> None:
    """See what a table holds before any of it is read."""
    about = file.metadata
    if about.num_rows not in counts:
        wanted = f"{counts[0]:,} to {counts[-1]:,}" if len(counts) > 1 else f"{counts[0]:,}"
        raise DamagedFile(f"has {about.num_rows:,} rows; {said_by} says {wanted}")
    plain = pa.schema([_plain(field) for field in file.schema_arrow])
    if plain != schema:
        raise DamagedFile(f"has other columns: {', '.join(plain.names)}")
    if not about.created_by.startswith(_WRITER):
        raise DamagedFile("was written by another program")


def _check_columns(path: Path, about: pq.FileMetaData, schema: pa.Schema, most_listed: int) -> None:
    """See what Arrow will set memory aside for, and in what encodings."""
    if about.num_rows == 0:
        return  # nothing is read
    groups = [about.row_group(index) for index in range(about.num_row_groups)]
    if sum(group.num_rows for group in groups) != about.num_rows or any(group.num_rows < 1 for group in groups):
        raise DamagedFile("contradicts itself about its rows")
    with path.open("rb") as file:
        for index, field in enumerate(schema):
            pages = [page for group in groups for page in _pages(file, group.column(index))]
            most = max(most_listed, about.num_rows) if pa.types.is_list(field.type) else about.num_rows
            _check_pages(field.name, pages, range(about.num_rows, most + 1))


def _pages(file: BinaryIO, column: pq.ColumnChunkMetaData) -> Iterator[Page]:
    start = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < start:
        start = column.dictionary_page_offset
    return list_pages(file, start, column.total_compressed_size)


def _check_pages(name: str, pages: Sequence[Page], counts: range) -> None:
    """See that a column's pages hold one of so many values, an empty list and a missing one counted as a value."""
    size = sum(page.uncompressed for page in pages)
    values = sum(page.values for page in pages if not page.is_dictionary)
    if values not in counts or any(page.values > values for page in pages):
        raise DamagedFile(f"holds {values:,} values in the column {name} of {counts[0]:,} rows")
    if size > _COLUMN_BYTES + values * _VALUE_BYTES:
        raise DamagedFile(f"claims {size:,} bytes for the column {name} of {counts[0]:,} rows")
    if not {page.encoding for page in pages} <= _ENCODINGS:
        raise DamagedFile(f"holds the column {name} in an encoding that is not ours")


def _plain(field: pa.Field) -> pa.Field:
    """The field as it was written: text is read as a dictionary, so that a word that recurs takes its room once."""
    kind = field.type
    return field.with_type(kind.value_type) if pa.types.is_dictionary(kind) else field
