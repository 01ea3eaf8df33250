"""An MCAP writer that decides itself where a chunk ends: an episode has chunks of its own.

The official Python writer (mcap 1.6) closes a chunk when it is large enough and offers no way to close one
earlier, so an episode could not be read with one seek. The records are its own (``mcap.records``); only the
chunks are put together here. Specification: https://mcap.dev/spec.

Layout: header, schemas, channels; for each episode a metadata record and its chunks with their message
indexes; the summary. Schemas stand before the first chunk, so every whole chunk of a truncated file can be read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple, Protocol, runtime_checkable

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from dmotion_bench.storage.schema import MessageType

MAGIC: Final = b"\x89MCAP0\r\n"
LIBRARY: Final = "dmbench/1"  # the format, not a package's version: the same recipe makes the same bytes
COMPRESSION: Final = "zstd"
COMPRESSION_LEVEL: Final = 5
WINDOW_LOG: Final = 23  # 8 MiB: what a frame shares with all earlier ones of its episode is found
CHUNK_LIMIT: Final = 16 * 2**20
"""A chunk that has grown to this many bytes is closed; an episode may have several."""

RECORD_HEAD: Final = struct.Struct("<BQ")  # opcode, length
MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")  # record head, channel, sequence, log time, publish time
CHUNK_HEAD: Final = struct.Struct("<QQQI")  # first time, last time, uncompressed size, CRC-32
_INDEX_HEAD: Final = struct.Struct("<HI")  # channel, size of the entries
_FOOTER_HEAD: Final = struct.Struct("<BQQQ")  # record head, the start of the summary, of the summary offsets


class Message(NamedTuple):
    """One message: its channel's number, the time that it is about [ns], its serialised content in pieces.

    A picture among the pieces is a view of the picture's own memory: it is copied once, into its chunk.
    """

    channel: int
    t_ns: int
    pieces: tuple[bytes | memoryview, ...]

    @property
    def size(self) -> int:
        """Of the content [bytes]."""
        return sum(map(len, self.pieces))


class Span(NamedTuple):
    """A position in a file: first byte and number of bytes."""

    offset: int
    size: int


@runtime_checkable
class Sink(Protocol):
    """Something to write bytes to: an open file, or a wrapper around one."""

    def write(self, data: bytes, /) -> int:
        """Write all of ``data``."""


class McapWriter:
    """Writes one MCAP file to a stream that the caller opens and closes."""

    def __init__(self, stream: Sink, channels: Iterable[tuple[str, MessageType]]) -> None:
        self._stream, self._position, self._crc = stream, 0, 0
        settings = zstandard.ZstdCompressionParameters.from_level(
            COMPRESSION_LEVEL, window_log=WINDOW_LOG, write_checksum=False
        )
        self._compressor = zstandard.ZstdCompressor(compression_params=settings)
        types: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        for number, (topic, kind) in enumerate(channels, start=1):
            schema = types.setdefault(
                kind.name,
                Schema(id=len(types) + 1, name=kind.name, encoding="protobuf", data=kind.descriptors),
            )
            self._channels.append(
                Channel(id=number, topic=topic, message_encoding="protobuf", metadata={}, schema_id=schema.id)
            )
        self._schemas = list(types.values())
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts = dict.fromkeys(range(1, len(self._channels) + 1), 0)
        self._write(MAGIC)
        self._write(_records([Header(profile="", library=LIBRARY), *self._schemas, *self._channels]))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write key-value pairs, outside any chunk."""
        record = _records([Metadata(name=name, metadata=dict(values))])
        self._metadata.append(MetadataIndex(offset=self._position, length=len(record), name=name))
        self._write(record)

    def chunks(self, messages: Iterable[Message]) -> Span:
        """Write messages, which must be in the order of their times, as chunks that hold nothing else."""
        start, held, size = self._position, list[Message](), 0
        for message in messages:
            held.append(message)
            size += MESSAGE_HEAD.size + message.size
            if size >= CHUNK_LIMIT:
                self._chunk(held)
                held, size = [], 0
        if held:
            self._chunk(held)
        return Span(start, self._position - start)

    def _chunk(self, messages: list[Message]) -> None:
        parts: list[bytes | memoryview] = []
        index: dict[int, list[tuple[int, int]]] = {}
        position = 0
        for message in messages:
            length = MESSAGE_HEAD.size - RECORD_HEAD.size + message.size
            sequence = self._counts[message.channel]
            head = MESSAGE_HEAD.pack(Opcode.MESSAGE, length, message.channel, sequence, message.t_ns, message.t_ns)
            parts += (head, *message.pieces)
            index.setdefault(message.channel, []).append((message.t_ns, position))
            self._counts[message.channel] = sequence + 1
            position += RECORD_HEAD.size + length
        raw = b"".join(parts)
        packed = self._compressor.compress(raw)
        first, last, name = messages[0].t_ns, messages[-1].t_ns, COMPRESSION.encode()
        head = CHUNK_HEAD.pack(first, last, len(raw), zlib.crc32(raw))
        head += struct.pack(f"<I{len(name)}sQ", len(name), name, len(packed))
        chunk = Span(self._position, RECORD_HEAD.size + len(head) + len(packed))
        self._write(RECORD_HEAD.pack(Opcode.CHUNK, len(head) + len(packed)), head, packed)
        offsets = {}
        for channel, records in index.items():
            offsets[channel] = self._position
            entries = struct.pack(f"<{2 * len(records)}Q", *(number for entry in records for number in entry))
            self._write(
                RECORD_HEAD.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD.size + len(entries)),
                _INDEX_HEAD.pack(channel, len(entries)),
                entries,
            )
        self._chunks.append(
            ChunkIndex(
                chunk_start_offset=chunk.offset,
                chunk_length=chunk.size,
                message_start_time=first,
                message_end_time=last,
                message_index_offsets=offsets,
                message_index_length=self._position - chunk.offset - chunk.size,
                compression=COMPRESSION,
                compressed_size=len(packed),
                uncompressed_size=len(raw),
            )
        )

    def finish(self) -> None:
        """Write the summary; the stream stays open."""
        self._write(_records([DataEnd(data_section_crc=self._crc)]))
        start = self._position
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas)),
            (Opcode.CHANNEL, list(self._channels)),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self._chunks)),
            (Opcode.METADATA_INDEX, list(self._metadata)),
        ]
        summary, offsets = b"", list[McapRecord]()
        for opcode, records in groups:
            group = _records(records)
            if group:
                offsets.append(
                    SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(group))
                )
            summary += group
        offsets_start = start + len(summary)
        summary += _records(offsets)
        footer = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_HEAD.size - RECORD_HEAD.size + 4, start, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._write(summary)
        self._write(_records([Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc)]))
        self._write(MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            message_count=sum(self._counts.values()),
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=0,
            metadata_count=len(self._metadata),
            chunk_count=len(self._chunks),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            channel_message_counts={channel: count for channel, count in self._counts.items() if count},
        )

    def _write(self, *parts: bytes) -> None:
        for part in parts:
            self._stream.write(part)
            self._position += len(part)
            self._crc = zlib.crc32(part, self._crc)


def _records(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call] # mcap's own
    return data
