"""MCAP: records and chunks, their lengths, kinds, checksums, order; messages, schemas, metadata within them."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

import lz4.frame
import numpy as np
import zstandard

from tests.fuzz.mutations import pick
from tests.fuzz.mutations.json_text import spoil_json
from tests.fuzz.mutations.plain import TELLING, spoil_bytes
from tests.fuzz.mutations.wire import spoil_wire

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQI")
MESSAGE = struct.Struct("<HIQQ")
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGES, CHUNKS, INDEX, METADATA = 1, 2, 3, 4, 5, 6, 7, 12
TIMES = (0, 1, 10**9, 2**31 * 10**9, 2**63 - 1, 2**63, 2**64 - 1)
ZEROS = zstandard.ZstdCompressor(level=1).compress(bytes(256 << 20))
"""A quarter of a gigabyte in a few kilobytes."""
LARGEST = 1 << 20  # bytes of a chunk that is opened; the originals have far smaller ones

DEFINITIONS = (
    b"a/A x\n" + b"=" * 80 + b"\nMSG: a/A\na/A x\n",
    b"uint8[4294967295] data\nuint32 height\n",
    b"uint8[999999999999999999999] data\n",
    b"std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 big\nuint32 step\nfloat64[] data\n",
    b"string<=5 encoding\nuint8[<=3] data\n",
    b"int32 x " * 50_000,
    b"".join(b"a/A%d x\n%s\nMSG: a/A%d\n" % (n + 1, b"=" * 80, n + 1) for n in range(2000)),
    b'uint8 A=999999\nuint8 a 300\nstring s "\nbool b 7\n',
    b"\xff\xfe\x00",
    b"\n" * 100_000,
    b"wstring data\nuint8[] data\nuint8[] data\n",
    b"module a { struct B { sequence<octet> data; }; };",
)


@dataclass
class Record:
    """One record; ``lied`` is the length that is written in place of its own."""

    opcode: int
    body: bytes
    lied: int | None = None


@dataclass
class Chunk:
    """A chunk taken apart."""

    start: int
    end: int
    size: int
    crc: int
    compression: bytes
    records: list[Record]
    stored: bytes | None = None
    lies: dict[str, int] = field(default_factory=dict)


def spoil_mcap(rng: np.random.Generator, data: bytes, *, mend: bool) -> tuple[bytes, str]:
    """One or two changes of records or of what is in a chunk.

    Args:
        mend: Whether a chunk's checksum is made to fit what is in it now.
    """
    records = parse(data[len(MAGIC) :])
    if len(records) < 3:
        return spoil_bytes(rng, data)
    told = []
    for _ in range(int(rng.choice([1, 1, 2]))):
        chunks = [place for place, record in enumerate(records) if record.opcode == CHUNKS]
        if chunks and rng.random() < 0.7:
            place = pick(rng, chunks)
            chunk = opened(records[place].body)
            if chunk is not None:
                told.append(f"chunk: {_spoil_chunk(rng, chunk, mend)}")
                records[place] = Record(CHUNKS, closed(chunk, mend), records[place].lied)
                continue
        told.append(f"records: {_spoil_records(rng, records)}")
    end = MAGIC if rng.random() < 0.9 else pick(rng, (b"", b"MCAP", bytes(8)))
    return MAGIC + b"".join(map(_bytes, records)) + end, "; ".join(told)


def parse(data: bytes) -> list[Record]:
    """The records of a stretch of a file, as far as they are whole."""
    records, position = [], 0
    while position + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, position)
        body = data[position + HEAD.size : position + HEAD.size + length]
        if len(body) < length:
            break
        records.append(Record(opcode, body))
        position += HEAD.size + length
    return records


def _bytes(record: Record) -> bytes:
    return HEAD.pack(record.opcode, len(record.body) if record.lied is None else record.lied) + record.body


def opened(body: bytes) -> Chunk | None:
    """A chunk's parts; None where it cannot be unpacked."""
    try:
        start, end, size, crc = CHUNK.unpack_from(body)
        (length,) = struct.unpack_from("<I", body, CHUNK.size)
        at = CHUNK.size + 4 + length
        compression, stored = body[CHUNK.size + 4 : at], body[at + 8 :]
        if compression == b"zstd":
            raw = zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
        else:
            raw = lz4.frame.decompress(stored) if compression == b"lz4" else stored
    except (struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError):
        return None
    if len(raw) > LARGEST:
        return None
    return Chunk(start, end, size, crc, compression, parse(raw))


def closed(chunk: Chunk, mend: bool) -> bytes:
    """The body of a chunk's record."""
    raw = b"".join(map(_bytes, chunk.records))
    crc = (zlib.crc32(raw) if chunk.crc else 0) if mend else chunk.crc
    stored = chunk.stored
    if stored is None:
        pack = {b"zstd": zstandard.ZstdCompressor().compress, b"lz4": lz4.frame.compress}.get(chunk.compression, bytes)
        stored = pack(raw)
    size = chunk.lies.get("size", len(raw))
    head = CHUNK.pack(chunk.start, chunk.end, size, chunk.lies.get("crc", crc))
    name = struct.pack("<I", chunk.lies.get("name", len(chunk.compression))) + chunk.compression
    return head + name + struct.pack("<Q", chunk.lies.get("stored", len(stored))) + stored


def _spoil_chunk(rng: np.random.Generator, chunk: Chunk, mend: bool) -> str:
    kind = pick(rng, ("records",) * 8 + ("size", "crc", "stored", "name", "times", "bomb", "garbage", "method"))
    if kind == "records" and chunk.records:
        return _spoil_records(rng, chunk.records)
    if kind == "size":
        chunk.lies["size"] = pick(rng, (*TELLING, chunk.size + 1, chunk.size - 1, 256 << 20))
    elif kind == "crc":
        chunk.lies["crc"] = pick(rng, (chunk.crc ^ 1, 1, 2**32 - 1) if not mend else (0, chunk.crc ^ 1))
    elif kind == "stored":
        chunk.lies["stored"] = pick(rng, TELLING)
    elif kind == "name":
        chunk.lies["name"] = pick(rng, (0, 1, 5, 2**31, 2**32 - 1))
    elif kind == "times":
        chunk.start, chunk.end = pick(rng, TIMES), pick(rng, TIMES)
    elif kind == "bomb":
        chunk.stored, chunk.compression = ZEROS, b"zstd"
        chunk.lies["size"] = pick(rng, (256 << 20, chunk.size, 0, 2**40))
    elif kind == "method":
        chunk.compression = pick(rng, (b"zstd", b"lz4", b"", b"br", b"\xff", b"none", b"zstd\0", b"x" * 300))
    else:
        raw = closed(chunk, mend)[CHUNK.size + 12 + len(chunk.compression) :]
        chunk.stored = spoil_bytes(rng, raw)[0]
    return kind


def _spoil_records(rng: np.random.Generator, records: list[Record]) -> str:
    place = int(rng.integers(len(records)))
    record = records[place]
    kind = pick(rng, ("content",) * 6 + ("drop", "twice", "swap", "opcode", "length", "insert"))
    if kind == "drop":
        del records[place]
    elif kind == "twice":
        records[place:place] = [record] * int(rng.choice([1, 1, 50]))
    elif kind == "swap":
        other = int(rng.integers(len(records)))
        records[place], records[other] = records[other], records[place]
    elif kind == "opcode":
        record.opcode = int(rng.integers(0, 17)) if rng.random() < 0.8 else int(rng.integers(256))
    elif kind == "length":
        record.lied = pick(rng, (*TELLING, len(record.body) + 1, max(len(record.body) - 1, 0), len(record.body) * 2))
    elif kind == "insert":
        records.insert(place, Record(int(rng.integers(256)), rng.bytes(int(rng.integers(64)))))
    else:
        record.body = _content(rng, record)
    return f"{kind} {record.opcode}"


def _content(rng: np.random.Generator, record: Record) -> bytes:
    body = record.body
    if record.opcode == MESSAGES and len(body) >= MESSAGE.size:
        channel, sequence, log, publish = MESSAGE.unpack_from(body)
        data, kind = body[MESSAGE.size :], pick(rng, ("data",) * 6 + ("log", "channel", "publish"))
        if kind == "data":
            data = _message(rng, data)
        elif kind == "log":
            log = pick(rng, (*TIMES, log + 10**9, max(log - 10**9, 0), log + 10**14)) & (2**64 - 1)
        elif kind == "channel":
            channel = pick(rng, (0, 1, 2, 3, 4, 5, 6, 65535))
        else:
            publish = pick(rng, TIMES)
        return MESSAGE.pack(channel, sequence, log, publish) + data
    if record.opcode in (SCHEMA, CHANNEL, METADATA, HEADER) and rng.random() < 0.8:
        return _strings(rng, record.opcode, body)
    return spoil_bytes(rng, body)[0]


def _message(rng: np.random.Generator, data: bytes) -> bytes:
    if data[:1] == b"{":
        return spoil_json(rng, data)[0]
    if data[:4] in (b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"):
        return _cdr(rng, data)
    return spoil_wire(rng, data)


def _cdr(rng: np.random.Generator, data: bytes) -> bytes:
    """A ROS 2 message: one of its numbers of four bytes, which are most of its lengths and sizes, or any bytes."""
    if len(data) < 12 or rng.random() < 0.4:
        return spoil_bytes(rng, data)[0]
    out = bytearray(data)
    at = 4 + 4 * int(rng.integers(min(len(data) - 8, 80) // 4))
    (old,) = struct.unpack_from("<I", out, at)
    struct.pack_into(
        "<I", out, at, pick(rng, (0, 1, 7, old + 1, old * 2, 2**31 - 1, 2**31, 2**32 - 1, 10**6)) & (2**32 - 1)
    )
    return bytes(out)


def _strings(rng: np.random.Generator, opcode: int, body: bytes) -> bytes:
    """A record of numbers, texts with their lengths, and pairs of texts."""
    skip = {SCHEMA: 2, CHANNEL: 4, METADATA: 0, HEADER: 0}[opcode]
    texts, position = [], skip
    while position + 4 <= len(body):
        (length,) = struct.unpack_from("<I", body, position)
        if position + 4 + length > len(body):
            break
        texts.append(body[position + 4 : position + 4 + length])
        position += 4 + length
    if not texts:
        return spoil_bytes(rng, body)[0]
    place, head = int(rng.integers(len(texts))), bytearray(body[:skip])
    if skip and rng.random() < 0.15:
        struct.pack_into("<H", head, skip - 2 if rng.random() < 0.5 else 0, pick(rng, (0, 1, 2, 3, 65535)))
    elif opcode == SCHEMA and rng.random() < 0.6:
        old = texts[-1]
        texts[-1] = pick(rng, (*DEFINITIONS, spoil_wire(rng, old), spoil_wire(rng, old), spoil_bytes(rng, old)[0]))
    else:
        known = (b"foxglove.RawImage", b"foxglove.CompressedImage", b"sensor_msgs/msg/Image", b"protobuf", b"json")
        known += (b"ros2msg", b"ros2idl", b"cdr", b"jsonschema", b"/camera", b"/action", b"")
        numbers = (b"0", b"-1", b"9" * 5000, b"1e3", b"\xff", b"18446744073709551616", b" 3", "٣".encode())
        texts[place] = pick(rng, (*known, *numbers, texts[place] + b"x", b"x" * 200_000, b"\x1b[2J"))
    tail = body[position:]
    lied = rng.random() < 0.05
    return (
        bytes(head)
        + b"".join(
            struct.pack("<I", 2**32 - 1 if lied and n == place else len(one)) + one for n, one in enumerate(texts)
        )
        + tail
    )
