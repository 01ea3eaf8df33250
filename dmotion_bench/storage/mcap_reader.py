"""Reading our own MCAP files: the chunks of one episode with one seek, and the list of what a file holds.

Every size that a file declares is checked before memory is set aside for it, and every chunk against its
CRC-32, so that a damaged or hostile file ends in ``DamagedFile`` and never in a wrong frame. Foreign files are
read with the official reader, by the import.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import stat
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Metadata

from dmotion_bench.storage.mcap_writer import (
    CHUNK_HEAD,
    COMPRESSION,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    WINDOW_LOG,
    Span,
)
from dmotion_bench.wording import sentence

_CHUNK_TAIL: Final = struct.Struct(f"<I{len(COMPRESSION)}sQ")  # compression's name, compressed size
_FIXED: Final = CHUNK_HEAD.size + _CHUNK_TAIL.size
_METADATA_LIMIT: Final = 2**20  # [bytes]
_LOST: Final = (errno.EIO, errno.EBADMSG, getattr(errno, "EUCLEAN", errno.EIO))  # a disk's, a file system's checksums


class DamagedFile(Exception):
    """The bytes are not what was written; the text says where and why."""

    def __init__(self, said: str) -> None:
        super().__init__(sentence(said))


@contextlib.contextmanager
def lost_is_damaged() -> Iterator[None]:
    """What the disk can no longer read is damaged like what it reads wrongly: only what needs these bytes is lost.

    Raises:
        DamagedFile: In place of the operating system's error.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _LOST:
            raise
        raise DamagedFile(f"cannot be read from the disk: {error.strerror}") from None


class MessageView(NamedTuple):
    """One message of a chunk: its channel's number, its time [ns], its serialised content."""

    channel: int
    t_ns: int
    data: memoryview


class Room:
    """Memory that chunks are unpacked into one after the other: what is set aside anew costs more than unpacking."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def of(self, size: int) -> memoryview:
        """So many bytes, those of the chunk before."""
        if size > len(self._bytes):
            self._bytes = bytearray(size)
        return memoryview(self._bytes)[:size]


def read_messages(path: Path, span: Span, *, chunk_limit: int, room: Room | None = None) -> Iterator[MessageView]:
    """The messages of the chunks that stand in ``span``.

    Args:
        path: The file.
        span: As ``McapWriter.chunks`` returned it.
        chunk_limit: Largest uncompressed chunk that is accepted [bytes].
        room: Where chunks are unpacked; a message is then gone once that of the next chunk is asked for. None takes
            new memory for each.
    """
    with lost_is_damaged(), _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        end = span.offset + span.size
        if span.offset < 0 or span.size < 0 or end > size:
            raise DamagedFile(f"ends after {size} bytes, in the middle of what stands at {span.offset} to {end}")
        file.seek(span.offset)
        position = span.offset
        while position < end:
            opcode, length = _head(file.read(min(RECORD_HEAD.size, end - position)))
            if length > end - position - RECORD_HEAD.size:
                raise DamagedFile(f"holds a record at byte {position} that runs past the episode's end")
            if opcode == Opcode.CHUNK:
                if length > chunk_limit + chunk_limit // 64 + _FIXED:  # noise grows when it is compressed
                    raise DamagedFile(f"holds a chunk of {length} bytes at byte {position}, more than can be right")
                yield from _chunk_messages(memoryview(file.read(length)), chunk_limit, position, room)
            elif opcode == Opcode.MESSAGE_INDEX:
                file.seek(length, os.SEEK_CUR)
            else:
                raise DamagedFile(f"holds a record of kind {opcode} at byte {position}, where a chunk was expected")
            position += RECORD_HEAD.size + length


def _opened(path: Path) -> BinaryIO:
    """The file, open; a pipe in its place would be waited for."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise DamagedFile("is no ordinary file")
    return path.open("rb")


def _head(data: bytes) -> tuple[int, int]:
    try:
        opcode, length = RECORD_HEAD.unpack(data)
    except struct.error as error:
        raise DamagedFile(f"holds a record that is cut off: {error}") from None
    return opcode, length


def _chunk_messages(body: memoryview, limit: int, where: int, room: Room | None) -> Iterator[MessageView]:
    if len(body) < _FIXED:
        raise DamagedFile(f"holds a chunk at byte {where} that is cut off")
    _, _, uncompressed, crc = CHUNK_HEAD.unpack_from(body)
    name_size, name, packed_size = _CHUNK_TAIL.unpack_from(body, CHUNK_HEAD.size)
    packed = body[_FIXED:]
    if name_size != len(COMPRESSION) or name != COMPRESSION.encode() or packed_size != len(packed):
        raise DamagedFile(f"holds a chunk at byte {where} whose head is garbled")
    if uncompressed > limit:
        raise DamagedFile(
            f"holds a chunk at byte {where} that claims {uncompressed} bytes; at most {limit} can be right"
        )
    try:
        declared = zstandard.get_frame_parameters(packed).content_size
        if declared != uncompressed:  # zstandard would set aside what the frame declares, whatever we allow
            raise DamagedFile(f"holds a chunk at byte {where} that contradicts itself about its size")
        raw = _unpacked(packed, (room or Room()).of(uncompressed), where)
    except zstandard.ZstdError as error:
        raise DamagedFile(f"holds a chunk at byte {where} that cannot be decompressed: {error}") from None
    if zlib.crc32(raw) != crc:
        raise DamagedFile(f"holds a chunk at byte {where} that does not match its checksum")
    data, position = raw, 0
    while position < len(data):
        try:
            opcode, length, channel, _, t_ns, _ = MESSAGE_HEAD.unpack_from(data, position)
        except struct.error as error:
            raise DamagedFile(f"holds a message in the chunk at byte {where} that is cut off: {error}") from None
        end = position + RECORD_HEAD.size + length
        if opcode != Opcode.MESSAGE or end > len(data) or end < position + MESSAGE_HEAD.size:
            raise DamagedFile(f"holds a message in the chunk at byte {where} that is garbled")
        yield MessageView(channel, t_ns, data[position + MESSAGE_HEAD.size : end])
        position = end


def _unpacked(packed: memoryview, into: memoryview, where: int) -> memoryview:
    """Fill ``into`` with the content of one frame of Zstandard, which has that very size."""
    largest = max(2**WINDOW_LOG, len(into))  # of the window that the frame may ask memory for
    with zstandard.ZstdDecompressor(max_window_size=largest).stream_reader(packed) as stream:
        done = 0
        while done < len(into) and (count := stream.readinto(into[done:])):
            done += count
        if done < len(into):
            raise DamagedFile(f"holds a chunk at byte {where} that is cut off")
    return into


class Section(NamedTuple):
    """What follows a metadata record: its name and values, and where the chunks after it stand."""

    name: str
    values: Mapping[str, str]
    span: Span

    @property
    def kind(self) -> str:
        """The name without the number that makes it unique."""
        return self.name.partition(" ")[0]


def list_sections(path: Path, *, most: int, salvage: bool = False) -> list[Section]:
    """What a file holds, by walking its records; no chunk is decompressed.

    Args:
        path: The file.
        most: How many sections it can have.
        salvage: Stop at the first thing that is wrong, with what came before it, instead of raising.
    """
    found: list[Section] = []
    try:
        with lost_is_damaged(), _opened(path) as file:
            for section in _sections(file, most):
                if section.span.size == 0:
                    found.append(section)
                else:
                    found[-1] = section
    except DamagedFile:
        if not salvage:
            raise
    return found


def _sections(file: BinaryIO, most: int) -> Iterator[Section]:
    """Each section when it begins, empty, and again whenever it has grown."""
    size = os.fstat(file.fileno()).st_size
    if file.read(len(MAGIC)) != MAGIC:
        raise DamagedFile("does not start as an MCAP file")
    section: Section | None = None
    count = 0
    for opcode, start, length in _walk(file, size):
        end = start + RECORD_HEAD.size + length
        if opcode == Opcode.METADATA:
            if length > _METADATA_LIMIT:
                raise DamagedFile(f"holds a metadata record of {length} bytes")
            count += 1
            if count > most:
                raise DamagedFile(f"holds more than {most:,} sections")
            section = Section(*_metadata(file.read(length)), Span(end, 0))
            yield section
        elif opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            if section is None:
                raise DamagedFile("holds a chunk that belongs to nothing")
            section = section._replace(span=Span(section.span.offset, end - section.span.offset))
            yield section
        elif opcode == Opcode.DATA_END:
            return
    raise DamagedFile(f"ends after {size} bytes, before its summary")


def _walk(file: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Kind, first byte and length of each record; the stream stands at its content."""
    position = file.tell()
    while position + RECORD_HEAD.size <= size:
        file.seek(position)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        if position + RECORD_HEAD.size + length > size:
            raise DamagedFile(f"ends after {size} bytes, in the middle of a record")
        yield opcode, position, length
        position += RECORD_HEAD.size + length


def _metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Name and pairs of a metadata record."""
    try:
        record = Metadata.read(ReadDataStream(io.BytesIO(content)))
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise DamagedFile(f"holds a garbled metadata record: {error}") from None
    return record.name, record.metadata
