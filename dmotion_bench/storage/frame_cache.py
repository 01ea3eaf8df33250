"""All frames of a data set, decoded once into an Arrow file that is memory-mapped.

Random triplets straight out of MCAP come at about 1,000 a second, out of this file at 100,000 (decision 008).
The file is derived: it is named after the data set's fingerprint, made anew when that changes or when it is damaged,
and safe to delete. It is one record batch with the columns ``frame`` and ``crc32``, so any Arrow reader opens it.

A frame is held against its checksum when it is first used, so a frame that is not what was decoded is never used:
the file is then made anew, and whoever asked gets the frame of the new one.
"""

from __future__ import annotations

import contextlib
import io
import logging
import mmap
import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int, UInt8, UInt32

from dmotion_bench.errors import CacheNotWritable, DatasetCorrupt, StorageFull
from dmotion_bench.storage.atomic import atomic_file, remove_leftovers
from dmotion_bench.storage.lock import in_turn
from dmotion_bench.wording import shown
from dmotion_bench.workspace import ANOTHER_CACHE

_FINGERPRINT: Final = b"dmbench.fingerprint"
_FRAMES, _SUMS = "frame", "crc32"
_MAGIC: Final = 8  # bytes that an Arrow file begins with
_HEADER, _COMPRESSION = 2, 3  # fields of Arrow's Message and RecordBatch
_MOST_AROUND: Final = 2**16  # bytes of a file besides its columns
_GIB: Final = 2**30
_log = logging.getLogger(__name__)
Episodes = Iterable[UInt8[np.ndarray, "t h w 3"]]


class Mapped(NamedTuple):
    """The content of a cache's file, as it is on disk."""

    frames: UInt8[np.ndarray, "n h w 3"]
    sums: UInt32[np.ndarray, " n"]

    def is_sound(self, place: int) -> bool:
        """Whether a frame has its checksum."""
        return checksum(self.frames[place], place) == int(self.sums[place])


def cache_name(fingerprint: str) -> str:
    """The file's name."""
    return f"frames-{fingerprint[:16]}.arrow"


def checksum(frame: UInt8[np.ndarray, "h w 3"], place: int) -> int:
    """The CRC-32 of a frame; it begins with the frame's number, so that a frame in another's place is noticed."""
    return zlib.crc32(frame.data, place & 0xFFFFFFFF)


@dataclass(frozen=True, kw_only=True)
class CacheFile:
    """Where the cache of a data set is, and what it must hold.

    Attributes:
        folder: Where caches are.
        fingerprint: The data set's.
        count: How many frames it has.
        height, width: Of a frame [px].
    """

    folder: Path
    fingerprint: str
    count: int
    height: int
    width: int

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / cache_name(self.fingerprint)

    @property
    def bytes(self) -> int:
        """What the frames take."""
        return self.count * self.height * self.width * 3

    @property
    def _schema(self) -> pa.Schema:
        kinds = (pa.field(_FRAMES, pa.binary(self.height * self.width * 3), False), pa.field(_SUMS, pa.uint32(), False))
        return pa.schema(kinds).with_metadata({_FINGERPRINT: self.fingerprint})

    def map(self) -> Mapped | None:
        """Map the file; None when it is not there, or is that of something else."""
        if not self.path.is_file():
            return None
        try:
            if not 0 <= self.path.stat().st_size - self.bytes - 4 * self.count <= _MOST_AROUND:
                return None
            batch = _mapped_batch(self.path, self._schema)
            if batch is None or batch.num_rows != self.count:
                return None
            batch.validate()
            frames, sums = batch.columns
            if frames.null_count or sums.null_count or frames.offset or sums.offset:
                return None
            pixels = np.frombuffer(frames.buffers()[1], np.uint8)[: self.bytes]
            numbers = np.frombuffer(sums.buffers()[1], np.uint32)[: self.count]
            return Mapped(pixels.reshape(self.count, self.height, self.width, 3), numbers.reshape(self.count))
        except (pa.ArrowException, OSError, EOFError, ValueError, IndexError, struct.error):
            return None

    def is_unchecked(self) -> bool:
        """Whether the file was written by a version that knew no checksums; it is never used."""
        try:
            with pa.memory_map(str(self.path)) as mapped:
                return bool(pa.ipc.open_file(mapped).schema.names == [_FRAMES])
        except (pa.ArrowException, OSError, ValueError):
            return False

    def lacking(self) -> str:
        """A sentence on the space that is lacking for the file; empty if it is there, or fits.

        It fits where a tenth of the free space is left over.
        """
        if self.path.is_file():
            return ""
        there = next(folder for folder in (self.folder, *self.folder.absolute().parents) if folder.is_dir())
        free = shutil.disk_usage(there).free
        if self.bytes <= 0.9 * free:
            return ""
        return (
            f"the frames take {self.bytes / _GIB:.1f} GiB as a cache, and {str(self.folder)!r} has room for "
            f"{free / _GIB:.1f} GiB"
        )

    def build(self, episodes: Episodes) -> None:
        """Write the file, an episode in memory at a time.

        Args:
            episodes: The frames of every episode, in order.

        Raises:
            CacheNotWritable: The folder can take no file.
            StorageFull: It has not enough space.
        """
        remove_leftovers(self.folder)
        self._require_space()
        sums = np.empty(self.count, np.uint32)
        with atomic_file(self.path) as file:
            places = _write_frame_of_file(file, self._schema, self.count)
            file.seek(places[_FRAMES])
            done = 0
            for frames in episodes:
                if done + len(frames) <= self.count:
                    sums[done : done + len(frames)] = [checksum(frame, done + n) for n, frame in enumerate(frames)]
                    file.write(frames.data)
                done += len(frames)
            if done != self.count:
                raise ValueError(f"{done} frames were given, not {self.count}")
            file.seek(places[_SUMS])
            file.write(sums.data)

    @contextlib.contextmanager
    def making(self) -> Iterator[None]:
        """Hold the lock for making the file within the block; another process that makes it is waited for.

        Raises:
            CacheNotWritable: The folder can take no file.
        """
        self._require_writable()
        with in_turn(self.path):
            yield

    def _require_writable(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._not_writable(str(error.strerror)) from None
        if not os.access(self.folder, os.W_OK):
            raise self._not_writable("it is read-only")
        if self.path.is_dir():
            raise self._not_writable(f"a folder has the name {self.path.name!r} there")

    def _require_space(self) -> None:
        self._require_writable()
        free = shutil.disk_usage(self.folder).free
        if self.bytes > free:
            raise StorageFull(
                f"the frames take {self.bytes / _GIB:.1f} GiB as a cache in {str(self.folder)!r}, where "
                f"{free / _GIB:.1f} GiB are free; free some, or {ANOTHER_CACHE}."
            )

    def _not_writable(self, why: str) -> CacheNotWritable:
        return CacheNotWritable(f"no cache can be written into {str(self.folder)!r}: {why}; {ANOTHER_CACHE}.")

    def remove_others(self) -> None:
        """Delete the caches of earlier states of the data set; only for a folder that no other data set uses."""
        for other in self.folder.glob("frames-*.arrow"):
            if other != self.path and not other.is_dir():  # which no version has written
                other.unlink(missing_ok=True)


class FrameCache:
    """The frames of a data set, mapped into memory, read-only; a damaged file is made anew.

    Args:
        file: Where they are.
        lengths: Frames of each episode.
        make: Writes the file.

    Attributes:
        offsets: Episode e is the frames ``offsets[e]`` to ``offsets[e + 1]``, exclusively.
    """

    def __init__(self, file: CacheFile, lengths: Int[np.ndarray, " e"], make: Callable[[], None]) -> None:
        self._file, self._make = file, make
        self.offsets: Int[np.ndarray, " o"] = np.concatenate([[0], np.cumsum(lengths)])  # o = e + 1
        self._sound: Bool[np.ndarray, " n"] = np.zeros(file.count, np.bool_)
        self._left = file.count
        mapped = file.map()
        if mapped is None and file.path.is_file():
            _log.warning("the cache %s is damaged, or of an earlier version; it is made anew.", shown(str(file.path)))
        self._mapped = mapped or self._made()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_mapped": None}  # another process maps the file itself

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._mapped = self._file.map() or self._made()

    @property
    def nbytes(self) -> int:
        """Size of all frames."""
        return self._mapped.frames.nbytes

    @property
    def frames(self) -> UInt8[np.ndarray, "n h w 3"]:
        """All episodes one after the other, all of them checked."""
        return self.checked(np.zeros(1, np.int64), self._file.count)

    def checked(self, first: Int[np.ndarray, " b"], length: int) -> UInt8[np.ndarray, "n h w 3"]:
        """All frames; those of the given pieces are what was decoded, the rest may not have been looked at yet.

        Args:
            first: Where each piece begins.
            length: Frames of a piece.

        Raises:
            DatasetCorrupt: A file that was just written does not hold what was written.
        """
        if self._left:
            places = first[:, None] + np.arange(length)
            if not self._sound[places].all():
                self._check(np.unique(places[~self._sound[places]]))
        return self._mapped.frames

    def episode(self, episode: int) -> UInt8[np.ndarray, "t h w 3"]:
        """One episode's frames, not copied."""
        first, stop = self.offsets[episode : episode + 2].tolist()
        return self.checked(np.array([first]), stop - first)[first:stop]

    def _check(self, places: Int[np.ndarray, " p"]) -> None:
        if not all(map(self._mapped.is_sound, places.tolist())):
            _log.warning("the cache %s is damaged; it is made anew.", shown(str(self._file.path)))
            self._mapped = self._made(places)
            self._sound[:], self._left = False, self._file.count
            if not all(map(self._mapped.is_sound, places.tolist())):
                raise DatasetCorrupt(
                    f"{str(self._file.path)!r} does not hold what was just written into it: the disk or the memory is "
                    f"not reliable; {ANOTHER_CACHE}."
                )
        self._sound[places] = True
        self._left -= len(places)

    def _made(self, places: Int[np.ndarray, " p"] | None = None) -> Mapped:
        """The file, made anew unless another process has done so; of that one the frames at the places are sound."""
        with self._file.making():
            mapped = self._file.map()
            if mapped is None or (places is not None and not all(map(mapped.is_sound, places.tolist()))):
                self._make()
                mapped = self._file.map()
        assert mapped is not None, "a cache that was just written can be mapped"
        return mapped


class _Holes(io.RawIOBase):
    """Passes bytes on to a file, but skips some buffers', which become holes.

    Attributes:
        places: Where each hole starts, by its buffer's address.
    """

    def __init__(self, file: BinaryIO, skipped: Iterable[pa.Buffer]) -> None:
        super().__init__()
        self._file = file
        self.places = {buffer.address: 0 for buffer in skipped}

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        if isinstance(data, pa.Buffer) and data.address in self.places and data.size:
            self.places[data.address] = self._file.tell()
            self._file.seek(data.size, os.SEEK_CUR)
            return int(data.size)
        return self._file.write(data)


def _write_frame_of_file(file: BinaryIO, schema: pa.Schema, rows: int) -> dict[str, int]:
    """Write an Arrow file of one batch whose columns are holes; where each starts.

    Arrow writes a batch from memory alone. It is given memory that is reserved, read-only and never touched,
    and what it writes of it is skipped in the file: neither memory nor time is spent on the zeros.
    """
    zeros = {field.name: _reserved(rows * field.type.byte_width) for field in schema}
    columns = [pa.Array.from_buffers(field.type, rows, [None, zeros[field.name]]) for field in schema]
    sink = _Holes(file, zeros.values())
    with pa.PythonFile(sink, "w") as stream, pa.ipc.new_file(stream, schema) as writer:
        writer.write_batch(pa.record_batch(columns, schema=schema))
    return {name: sink.places[buffer.address] for name, buffer in zeros.items()}


def _reserved(size: int) -> pa.Buffer:
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    return pa.py_buffer(mmap.mmap(-1, max(size, 1), flags=flags, prot=mmap.PROT_READ))


def _mapped_batch(path: Path, schema: pa.Schema) -> pa.RecordBatch | None:
    """The first batch of an Arrow file, in place; None if it has another schema, or Arrow would have to unpack it."""
    mapped = pa.memory_map(str(path))
    mapped.seek(_MAGIC)
    about = pa.ipc.read_message(mapped)
    if about.type != "schema" or not pa.ipc.read_schema(about).equals(schema, check_metadata=True):
        return None
    message = pa.ipc.read_message(mapped)
    if message.type != "record batch" or _is_compressed(message.metadata.to_pybytes()):
        return None
    return pa.ipc.read_record_batch(message, schema)


def _is_compressed(message: bytes) -> bool:
    """Whether a message's batch is compressed, by Arrow's ``Message.fbs``; pyarrow tells it of no batch.

    A batch that is compressed says itself how much memory it is to be unpacked into.
    """
    (root,) = struct.unpack_from("<I", message, 0)
    header = _field(message, root, _HEADER)
    (batch,) = struct.unpack_from("<I", message, header)
    return _field(message, header + batch, _COMPRESSION) != 0


def _field(flatbuffer: bytes, table: int, number: int) -> int:
    """Where a field of a table of FlatBuffers stands; 0 where it is left out."""
    (back,) = struct.unpack_from("<i", flatbuffer, table)
    places = table - back
    (size,) = struct.unpack_from("<H", flatbuffer, places)
    entry = 4 + 2 * number
    offset = struct.unpack_from("<H", flatbuffer, places + entry)[0] if entry < size else 0
    return table + offset if offset else 0
