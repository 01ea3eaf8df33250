"""The pages of a Parquet column, as their own headers describe them.

Arrow sets memory aside for what a page's header claims, whatever the footer says: 32 KB of file can become 4 GB. No
library that is installed here tells what the headers claim, so they are read here. They are written in Thrift's compact
protocol (https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md); the fields are those of
``PageHeader`` in https://github.com/apache/parquet-format/blob/master/src/main/thrift/parquet.thrift.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, Final, NamedTuple

Struct = dict[int, "int | Struct"]
"""Whole numbers and structs by the numbers of their fields; of other fields nothing is kept."""

_LARGEST_HEADER: Final = 4096  # [bytes]
_DEEPEST: Final = 4
_STOP, _TRUE, _FALSE, _BYTE, _WHOLE, _DOUBLE, _BINARY, _STRUCT = 0, 1, 2, 3, (4, 5, 6), 7, 8, 12
_UNCOMPRESSED, _COMPRESSED = 2, 3
_DATA, _DICTIONARY, _DATA_V2 = 5, 7, 8
_VALUES: Final = 1
_ENCODING: Final = {_DATA: 2, _DICTIONARY: 2, _DATA_V2: 4}


class Page(NamedTuple):
    """What a page claims.

    Attributes:
        uncompressed: Its size [bytes].
        values: How many it holds.
        encoding: The number of its encoding in parquet.thrift.
        is_dictionary: Whether its values stand for those of the other pages.
    """

    uncompressed: int
    values: int
    encoding: int
    is_dictionary: bool


def list_pages(file: BinaryIO, start: int, size: int) -> Iterator[Page]:
    """The pages of a column.

    Args:
        file: The Parquet file.
        start, size: Where the column stands in it.

    Raises:
        ValueError: There is something else than a chain of pages that fills this place.
    """
    position, end = start, start + size
    while position < end:
        file.seek(position)
        cursor = _Cursor(file.read(min(_LARGEST_HEADER, end - position)))
        header = cursor.struct(_DEEPEST)
        kinds = [kind for kind in (_DATA, _DICTIONARY, _DATA_V2) if kind in header]
        compressed, uncompressed = header.get(_COMPRESSED), header.get(_UNCOMPRESSED)
        if len(kinds) != 1 or not isinstance(compressed, int) or not isinstance(uncompressed, int):
            raise ValueError(f"what stands at byte {position} is no page")
        about = header[kinds[0]]
        values = about.get(_VALUES) if isinstance(about, dict) else None
        encoding = about.get(_ENCODING[kinds[0]]) if isinstance(about, dict) else None
        if not isinstance(values, int) or not isinstance(encoding, int) or min(compressed, uncompressed, values) < 0:
            raise ValueError(f"the page at byte {position} says nothing of its content")
        position += cursor.position + compressed
        yield Page(uncompressed, values, encoding, kinds[0] == _DICTIONARY)
    if position != end:
        raise ValueError(f"a page ends at byte {position}, beyond its column")


class _Cursor:
    """Reads Thrift's compact protocol out of some bytes.

    Attributes:
        position: Of the next byte.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self.position = data, 0

    def struct(self, depth: int) -> Struct:
        """A struct, up to and with its end."""
        fields: Struct = {}
        field = 0
        while (head := self._byte()) != _STOP:
            step, kind = head >> 4, head & 15
            field = field + step if step else self._whole()
            if kind in _WHOLE:
                fields[field] = self._whole()
            elif kind == _STRUCT and depth:
                fields[field] = self.struct(depth - 1)
            elif kind == _BINARY:
                self._skip(self._varint())
            elif kind in (_BYTE, _DOUBLE):
                self._skip(1 if kind == _BYTE else 8)
            elif kind not in (_TRUE, _FALSE):  # which have their value in their kind
                raise ValueError(f"a page's header holds a field of kind {kind}")
        return fields

    def _byte(self) -> int:
        if self.position >= len(self._data):
            raise ValueError("a page's header is cut off")
        self.position += 1
        return self._data[self.position - 1]

    def _skip(self, count: int) -> None:
        self.position += count
        if self.position > len(self._data):
            raise ValueError("a page's header is cut off")

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("a page's header holds a number of more than 64 bits")

    def _whole(self) -> int:
        """A zigzag number: 0, -1, 1, -2 ..."""
        value = self._varint()
        return value >> 1 if not value & 1 else -(value >> 1) - 1
