"""A reader of MCAP files that does not trust them: record by record, every length checked before it is used.

The ``mcap`` package's readers inflate a whole chunk at once, to whatever size the compressed bytes lead to,
and allocate what a length field says. Here a chunk is inflated as a stream and stopped at its declared size,
so a message is the largest thing ever held. The layout of records is https://mcap.dev/spec; their opcodes
and the parsing of channels and schemas are that package's own.

rosbag2 compresses in two more ways of its own: the file as a whole (``.mcap.zstd``) or each message for itself. Both
are inflated as they are read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader, BytesIO, RawIOBase
from pathlib import Path
from typing import IO, BinaryIO, Final, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from dmotion_bench.errors import RecordingImportError, RecordingTruncated
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.spans import Broken, Cut, Inflated, Readable, Span

MAGIC: Final = b"\x89MCAP0\r\n"
RECORD_HEAD: Final = struct.Struct("<BQ")
CHUNK_HEAD: Final = struct.Struct("<QQQI")
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
FOOTER: Final = struct.Struct("<QQI")
ZSTD_WINDOW: Final = 128 * MIB  # the zstd command's own limit; a frame may ask for 3 GiB
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"  # CDR begins with a zero
MOST_INFLATED: Final = 1000  # times its size, of a file as a whole; clean video in zstd is a hundred times smaller
LATEST: Final = 2**63 - 1  # [ns] times are kept as signed 64-bit integers


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A channel with the schema of its messages.

    Attributes:
        message_encoding: ``"cdr"``, ``"protobuf"``, ``"json"`` ...
        schema_encoding: ``"ros2msg"``, ``"ros2idl"``, ``"protobuf"``, ``"jsonschema"``; empty without a schema.
    """

    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message as it stands in the file; ``log_ns`` is when it was recorded."""

    topic: TopicInfo
    log_ns: int
    data: bytes


class _Directory:
    """The channels and schemas that a file has described so far."""

    def __init__(self) -> None:
        self.channels: dict[int, TopicInfo] = {}
        self._schemas: dict[int, Schema] = {}
        self._held = 0

    def add_schema(self, body: Span, largest: int) -> None:
        """Take note of a schema; a repeated one is the same by the specification."""
        schema = Schema.read(self._content(body, largest))
        self._held += 0 if schema.id in self._schemas else len(schema.data)
        self._schemas.setdefault(schema.id, schema)

    def add_channel(self, body: Span, largest: int) -> None:
        """Take note of a channel."""
        channel = Channel.read(self._content(body, largest))
        schema = self._schemas.get(channel.schema_id)
        if channel.schema_id and schema is None:
            raise Broken(f"channel {channel.id} names schema {channel.schema_id}, which is never given")
        described = TopicInfo(
            channel.topic,
            channel.message_encoding,
            "" if schema is None else schema.name,
            "" if schema is None else schema.encoding,
            b"" if schema is None else schema.data,
        )
        if self.channels.setdefault(channel.id, described).topic != channel.topic:
            raise Broken(f"channel {channel.id} is described twice, differently")

    def _content(self, body: Span, largest: int) -> ReadDataStream:
        if body.left > largest or self._held > 4 * largest:
            raise Broken("its schemas are larger than any real ones")
        return ReadDataStream(BytesIO(body.exactly(body.left)))


@dataclass
class _Chunks:
    """Which of a file's chunks have been read.

    Attributes:
        most: No more than so many are read; None: all.
        begun: So many have been.
        usable: The first so many hold nothing that a checksum speaks against; the last of them may end early.
        are_all: Whether the record was met that ends the data: no messages follow.
    """

    most: int | None = None
    begun: int = 0
    usable: int = 0
    are_all: bool = False


class McapFile:
    """One file, read from its beginning as often as it is asked for.

    Args:
        path: The file.
        limits: What it may make us do.
        salvage: Take a damaged file's messages up to the damage instead of refusing it; of a chunk whose checksum
            does not match, none.

    Attributes:
        is_harmed: Whether damage, or a cut, was met so far that is to be lived with; behind the last message it harms
            nothing.

    Raises:
        RecordingImportError: The file is not there, cannot be read, or is no MCAP file.
    """

    def __init__(self, path: Path, *, limits: ImportLimits, salvage: bool = False) -> None:
        self.path, self.limits, self.salvage = path, limits, salvage
        self._usable: int | None = None
        self.is_harmed = False
        try:
            with path.open("rb") as file:
                start = file.read(len(MAGIC))
                self._packed = start.startswith(ZSTD_MAGIC)
                if self._packed:
                    file.seek(0)
                    start = _inflating(file).read(len(MAGIC))
        except (OSError, zstandard.ZstdError) as error:
            raise RecordingImportError(f"cannot read {str(path)!r}: {error}.") from error
        if self._packed and len(start) < len(MAGIC):
            raise RecordingTruncated(f"{str(path)!r} is cut off: nothing can be inflated of what it holds.")
        if start != MAGIC:
            where = "holds no MCAP file, but is compressed as a whole" if self._packed else "is no MCAP file"
            raise RecordingImportError(f"{str(path)!r} {where}: it does not begin with MCAP's eight bytes.")

    def topics(self) -> list[TopicInfo]:
        """Every channel, sorted by topic: from the summary at the end, or from the whole file without one.

        Raises:
            RecordingTruncated: The file is damaged before the first of them.
        """
        found = self._summary_topics()
        if not found:
            known = _Directory()
            for _ in self._messages(frozenset(), known):
                pass
            found = list(known.channels.values())
        if not found and self.is_harmed:
            raise RecordingTruncated(
                f"{str(self.path)!r} is damaged or cut off near its beginning, and nothing whole stands before that: "
                "'--salvage' finds nothing to import. Leave the file out, or copy it again."
            )
        return sorted(set(found), key=lambda topic: (topic.topic, topic.schema_name))

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """The messages of some topics, in the order of the file.

        Raises:
            RecordingTruncated: The file ends in the middle (unless it is to be salvaged).
            RecordingImportError: It is damaged, or larger inside than the limits allow.
        """
        return self._messages(frozenset(topics), _Directory())

    def _messages(self, topics: frozenset[str], known: _Directory) -> Iterator[RawMessage]:
        """The messages; to salvage them, the file is read once before to find the chunks that can be used."""
        if not self.salvage:
            yield from self._read(topics, known, _Chunks())
            return
        if self._usable is None:
            seen = _Chunks()
            for _ in self._read(frozenset(), _Directory(), seen):
                pass
            self._usable = seen.usable
        yield from self._read(topics, known, _Chunks(most=self._usable))

    def _read(self, topics: frozenset[str], known: _Directory, chunks: _Chunks) -> Iterator[RawMessage]:
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            if self._packed:
                most = max(self.limits.chunk_bytes, MOST_INFLATED * size)
                source = BufferedReader(cast("RawIOBase", _inflating(file)), MIB)
                whole: Span = Inflated(source, most, "the file")
            else:
                whole = Span(file, size, lambda distance: file.seek(distance, 1))
            try:
                whole.exactly(len(MAGIC))
                yield from self._walk(whole, topics, known, chunks)
            except Cut:
                if isinstance(whole, Inflated) and whole.goes_on():
                    error: Exception = Broken(f"it inflates to more than {MOST_INFLATED:,} times its size")
                    self._damaged(file.tell(), error, chunks)
                    return
                if self.salvage:
                    self.is_harmed |= not chunks.are_all
                    return
                raise RecordingTruncated(
                    f"{str(self.path)!r} is cut off: it ends in the middle of a record, after {size:,} bytes; "
                    "import what stands before the cut with '--salvage'."
                ) from None
            except (Broken, EndOfFile, UnicodeDecodeError, struct.error, OverflowError) as found:
                if isinstance(whole, Inflated) and whole.at_end():
                    chunks.usable = chunks.begun  # the file ends in the middle of this one
                self._damaged(file.tell(), found, chunks)

    def _damaged(self, offset: int, error: Exception, chunks: _Chunks) -> None:
        if not self.salvage:
            raise RecordingImportError(
                f"{str(self.path)!r} is damaged near byte {offset:,}: {str(error)[:200] or type(error).__name__}; "
                "import what stands before the damage with '--salvage'."
            ) from None
        self.is_harmed |= not chunks.are_all

    def _walk(self, span: Span, topics: frozenset[str], known: _Directory, chunks: _Chunks) -> Iterator[RawMessage]:
        while True:
            opcode, length = RECORD_HEAD.unpack(span.exactly(RECORD_HEAD.size))
            body = span.part(length)
            if opcode == Opcode.FOOTER:
                return
            if opcode == Opcode.CHUNK:
                if chunks.begun == chunks.most:
                    return
                chunks.begun += 1
                crc, inside = self._chunk(body)
                if not crc:
                    chunks.usable = chunks.begun
                yield from self._walk_chunk(inside, crc, topics, known)
                chunks.usable = chunks.begun
            else:
                chunks.are_all |= opcode == Opcode.DATA_END
                message = self._record(opcode, body, topics, known)
                if message is not None:
                    yield message
            body.skip()

    def _walk_chunk(
        self,
        inside: Span,
        crc: int,
        topics: frozenset[str],
        known: _Directory,
    ) -> Iterator[RawMessage]:
        inside.crc = 0 if crc else None
        try:
            while inside.left:
                opcode, length = RECORD_HEAD.unpack(inside.exactly(RECORD_HEAD.size))
                body = inside.part(length)
                message = self._record(opcode, body, topics, known)
                if message is not None:
                    yield message
                body.skip()
        except Cut:
            raise Broken("a chunk holds less than it declares") from None
        if crc and inside.crc != crc:
            raise Broken("a chunk's checksum does not match its content")

    def _chunk(self, body: Span) -> tuple[int, Span]:
        _, _, declared, crc = CHUNK_HEAD.unpack(body.exactly(CHUNK_HEAD.size))
        compression = _short_string(body)
        (stored,) = struct.unpack("<Q", body.exactly(8))
        if declared > self.limits.chunk_bytes:
            raise RecordingImportError(
                f"{str(self.path)!r} has a chunk that declares {declared / MIB:,.0f} MiB, more than the "
                f"{self.limits.chunk_bytes // MIB:,} MiB that one may inflate to; if you trust the file, raise the "
                f"limit with '--max-chunk {-(-declared // MIB)}'."
            )
        packed = body.part(stored)
        if compression == "":
            if stored != declared:
                raise Broken("an uncompressed chunk declares another size than it has")
            return crc, packed
        if compression == "zstd":
            source: Readable = _inflating(packed)
        elif compression == "lz4":
            source = lz4.frame.LZ4FrameFile(packed)
        else:
            raise RecordingImportError(
                f"{str(self.path)!r} is compressed with {compression[:20]!r}; known are 'zstd' and 'lz4'. "
                "Convert it with 'mcap compress --compression zstd'."
            )
        return crc, Inflated(source, declared)

    def _record(
        self,
        opcode: int,
        body: Span,
        topics: frozenset[str],
        known: _Directory,
    ) -> RawMessage | None:
        if opcode == Opcode.MESSAGE:
            number, _, log_ns, _ = MESSAGE_HEAD.unpack(body.exactly(MESSAGE_HEAD.size))
            topic = known.channels.get(number)
            if topic is None:
                raise Broken(f"a message belongs to channel {number}, which is never described")
            if topic.topic not in topics:
                return None
            if body.left > self.limits.message_bytes:
                raise RecordingImportError(
                    f"{str(self.path)!r} has a message of {body.left / MIB:,.0f} MiB on {topic.topic!r}, more than the "
                    f"{self.limits.message_bytes // MIB} MiB that one may have."
                )
            if log_ns > LATEST:
                raise Broken(f"a message on {topic.topic!r} has the impossible time {log_ns} ns")
            data = body.exactly(body.left)
            if topic.message_encoding == "cdr" and data.startswith(ZSTD_MAGIC):
                data = self._inflated(topic, data)
            return RawMessage(topic, log_ns, data)
        if not opcode:  # the specification forbids it; a chunk of zeros would be a hundred million of them
            raise Broken("a record is of kind 0, which no record is")
        if opcode == Opcode.SCHEMA:
            known.add_schema(body, self.limits.schema_bytes)
        elif opcode == Opcode.CHANNEL:
            known.add_channel(body, self.limits.schema_bytes)
        return None

    def _inflated(self, topic: TopicInfo, data: bytes) -> bytes:
        """A message that rosbag2 has compressed for itself."""
        try:
            message = _inflating(BytesIO(data)).read(self.limits.message_bytes + 1)
        except zstandard.ZstdError as error:
            raise Broken(f"a compressed message on {topic.topic!r} cannot be inflated ({error})") from error
        if len(message) > self.limits.message_bytes:
            raise Broken(
                f"a message on {topic.topic!r} inflates to more than the {self.limits.message_bytes // MIB} MiB that "
                "one may have"
            )
        return message

    def _summary_topics(self) -> list[TopicInfo]:
        """The channels that the summary section repeats; none where there is no summary or it is damaged."""
        tail = RECORD_HEAD.size + FOOTER.size + len(MAGIC)
        size = self.path.stat().st_size
        if self._packed or size < tail + len(MAGIC):
            return []
        known = _Directory()
        with self.path.open("rb") as file:
            file.seek(-tail, 2)
            opcode, _ = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
            start, _, _ = FOOTER.unpack(file.read(FOOTER.size))
            if opcode != Opcode.FOOTER or file.read(len(MAGIC)) != MAGIC or not 0 < start < size - tail:
                return []
            file.seek(start)
            span = Span(file, size - start, lambda distance: file.seek(distance, 1))
            try:
                for _ in self._walk(span, frozenset(), known, _Chunks()):
                    pass
            except (Cut, Broken, EndOfFile, UnicodeDecodeError, struct.error, OverflowError):
                return []
        return list(known.channels.values())


def _short_string(body: Span) -> str:
    (length,) = struct.unpack("<I", body.exactly(4))
    if length > 256:
        raise Broken("a compression's name is longer than any real one")
    return body.exactly(length).decode()


def _inflating(packed: BinaryIO | Span) -> zstandard.ZstdDecompressionReader:
    """What bytes inflate to, as a stream."""
    decompressor = zstandard.ZstdDecompressor(max_window_size=ZSTD_WINDOW)
    return decompressor.stream_reader(cast("IO[bytes]", packed), read_across_frames=True)
