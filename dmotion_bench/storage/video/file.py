"""Video files that somebody else has written, opened without trust.

The container is told by its first bytes and FFmpeg is held to that one: a playlist that calls itself MP4 would make it
open other files and addresses. Outer lengths are compared with the file's size, as FFmpeg reads a file that was cut
off without a word. Times come from the file; AVI has none, only an order and a rate.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

import av
import av.logging
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import UInt8

from dmotion_bench.errors import RecordingImportError, RecordingTruncated
from dmotion_bench.storage.video.stream import DamagedPicture, PictureStream, decoder_options

av.logging.set_level(av.logging.PANIC)

CONTAINERS: Final = {"mp4": "mov", "mkv": "matroska", "avi": "avi"}
"""What FFmpeg calls the containers that ``container_of`` tells apart: QuickTime is an MP4, WebM a Matroska."""
_BOXES: Final = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp")
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
_LATEST: Final = 2**63 - 1
_A_SECOND_NS: Final = 1_000_000_000
_ROUNDED_NS: Final = 1_000  # times this close are one: most rates have no whole interval


def container_of(start: bytes) -> str | None:
    """``"mp4"``, ``"mkv"`` or ``"avi"`` by a file's first 16 bytes; None for anything else."""
    if start[4:8] in _BOXES:
        return "mp4"
    if start[:4] == _EBML:
        return "mkv"
    if start[:4] == b"RIFF" and start[8:12] == b"AVI ":
        return "avi"
    return None


class VideoFile:
    """One video stream of a file, read forward.

    Args:
        path: The file.
        camera: The number of the stream among those that are videos; None for the only one.
        pixels: Larger pictures are refused before they are decoded.
        salvage: Take what stands before a cut, and leave damaged pictures out; None where nobody can ask for that.

    Attributes:
        height, width: Of the first picture as it is shown [px].
        has_times: Whether the container keeps the time of each picture.
        rate: Pictures a second that the file declares; None where it does not.
        pixel_aspect: Width to height of a pixel as it is meant to be shown; 1 where the file does not say.
        is_harmed: Whether the file is shorter than it says, or damage was met so far behind which nothing can be read.

    Raises:
        RecordingTruncated: The file ends before it should.
        RecordingImportError: It is no video that can be read.
    """

    def __init__(self, path: Path, *, camera: str | None = None, pixels: int, salvage: bool | None = None) -> None:
        self.path, self._pixels, self._salvage = path, pixels, bool(salvage)
        self._way_out = "" if salvage is None else "; import {} with '--salvage'"
        with contextlib.ExitStack() as opened:
            file = opened.enter_context(path.open("rb"))
            kind = container_of(file.read(16))
            if kind is None:
                raise self._bad("is no MP4, MKV, WebM or AVI file")
            self.is_harmed = not _is_whole(file, kind, path.stat().st_size)
            if not salvage and self.is_harmed:
                raise RecordingTruncated(
                    f"the video {str(path)!r} is cut off: it is shorter than it says"
                    f"{self._way_out.format('what stands before the cut')}."
                )
            self.has_times = kind != "avi"
            self._container = opened.enter_context(self._open(file, CONTAINERS[kind]))
            self._stream = self._choose(camera)
            self._check_pixels(self._stream.height, self._stream.width)
            self._unit = self._stream.time_base or Fraction(1, 1000)
            rate = self._stream.average_rate or self._stream.guessed_rate
            self.rate = float(rate) if rate is not None and 0.001 <= rate <= 10_000 else None
            self.pixel_aspect = self._stream.sample_aspect_ratio or Fraction(1)
            self._decoder = self._new_decoder(midway=False)
            self._coming = self._decoded()
            self._first = next(self._coming, None)
            if self._first is None:
                raise self._bad("has no picture that can be decoded")
            self.height, self.width = self._decoder.size(self._first[1])
            self._opened = opened.pop_all()

    @property
    def damaged(self) -> int:
        """Pictures left out so far."""
        return self._decoder.damaged

    def frames(self) -> Iterator[tuple[int | None, VideoFrame]]:
        """Each picture from here on with its time [ns], None where it has none.

        Raises:
            RecordingImportError: A picture is damaged or too large.
        """
        if self._first is not None:
            first, self._first = self._first, None
            yield first
        yield from self._coming

    def frames_at(self, seconds: Sequence[float], within: float) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """The pictures that are nearest to some times.

        Args:
            seconds: The times in the file, ascending [s]. Exactly between two pictures the earlier one counts.
            within: So far from a time its picture may be [s].

        Raises:
            RecordingImportError: The file is damaged or lacks one.
        """
        waiting = [round(time * 1e9) for time in reversed(seconds)]
        if not waiting:
            return
        if waiting[-1]:
            self._go_before(waiting[-1])
        before: tuple[int, VideoFrame] | None = None
        for t_ns, frame in itertools.chain(self.frames(), [(_LATEST, None)]):
            if t_ns is None:
                continue
            while waiting and t_ns + _ROUNDED_NS >= waiting[-1]:
                early, late = _LATEST if before is None else waiting[-1] - before[0], abs(t_ns - waiting[-1])
                nearest = before[1] if before is not None and early <= late + _ROUNDED_NS else frame
                if nearest is None or min(early, late) > within * 1e9 + _ROUNDED_NS:
                    raise self._bad(f"lacks a picture at {waiting[-1] / 1e9:.3f} s, which its data set lists")
                yield self.rgb(nearest)
                waiting.pop()
            if not waiting:
                return
            assert frame is not None
            before = t_ns, frame

    def rgb(self, frame: VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """A picture's pixels.

        Raises:
            RecordingImportError: It is not as large as the first one, or cannot be made RGB.
        """
        at = "" if frame.pts is None else f" at {self._time(frame.pts) / 1e9:.3f} s"
        self.check_size(frame)
        try:
            return self._decoder.rgb(frame)
        except (FFmpegError, ValueError) as error:
            raise self._bad(f"has a picture{at} that cannot be made RGB: {str(error)[:120]}") from error

    def check_size(self, frame: VideoFrame) -> None:
        """Compare a picture's size with that of the first one.

        Raises:
            RecordingImportError: They differ.
        """
        height, width = self._decoder.size(frame)
        if (height, width) != (self.height, self.width):
            at = "" if frame.pts is None else f" at {self._time(frame.pts) / 1e9:.3f} s"
            raise self._bad(f"changes its size from {self.width}x{self.height} pixels to {width}x{height}{at}")

    def close(self) -> None:
        """Let go of the file."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, file: BinaryIO, kind: str) -> InputContainer:
        file.seek(0)
        try:
            opened = av.open(file, format=kind, options=decoder_options(self._pixels), metadata_errors="ignore")
        except MemoryError:
            raise
        except (FFmpegError, OSError) as error:
            raise self._bad(f"cannot be read: {error.strerror}") from error
        assert isinstance(opened, InputContainer)
        return opened

    def _choose(self, camera: str | None) -> VideoStream:
        """The stream that is meant; a cover picture is none."""
        cover = Disposition.attached_pic | Disposition.still_image
        streams = [stream for stream in self._container.streams.video if not stream.disposition & cover]
        streams = [stream for stream in streams if stream.codec_context is not None]
        names = [str(number) for number in range(len(streams))]
        if not streams:
            raise self._bad("has no video stream that can be decoded")
        if camera is None and len(streams) == 1:
            return streams[0]
        if camera not in names:
            which = f"has no video stream {camera!r}" if camera is not None else f"has {len(streams)} video streams"
            raise self._bad(f"{which}; choose one with '--camera': {', '.join(names)}")
        return streams[int(camera)]

    def _new_decoder(self, *, midway: bool) -> PictureStream:
        return PictureStream(self._stream.codec_context, pixels=self._pixels, salvage=self._salvage, midway=midway)

    def _decoded(self) -> Iterator[tuple[int | None, VideoFrame]]:
        at = 0
        try:
            for packet in self._container.demux(self._stream):
                if packet.size:  # an empty one is a picture that AVI repeats, or the end
                    at = self._time(packet.pts) if packet.pts is not None else at
                    for frame in self._decoder.decode(packet):
                        yield self._timed(frame)
            for frame in self._decoder.decode(None):
                yield self._timed(frame)
        except DamagedPicture as error:
            way_out = self._way_out.format("the others")
            raise self._bad(f"has a picture at {at / 1e9:.3f} s that {error}{way_out}") from error
        except MemoryError:
            raise
        except FFmpegError as error:
            if not self._salvage:
                way_out = self._way_out.format("what stands before")
                raise self._bad(f"is damaged after {at / 1e9:.3f} s: {error.strerror}{way_out}") from error
            self.is_harmed = True

    def _timed(self, frame: VideoFrame) -> tuple[int | None, VideoFrame]:
        self._check_pixels(frame.height, frame.width)
        return None if frame.pts is None else self._time(frame.pts), frame

    def _check_pixels(self, height: int, width: int) -> None:
        if height * width > self._pixels:
            raise self._bad(
                f"has pictures of {width}x{height} pixels, more than the {self._pixels:,} that one may have"
            )

    def _go_before(self, t_ns: int) -> None:
        """Go to a key frame that is shown at or before a time [ns].

        Containers look key frames up by when they are decoded. Where pictures are shown in another order, as in the
        open groups that x265 makes, the one that is found may be shown too late; then an earlier one is looked for.
        """
        back = 0
        while True:
            start = max(0, t_ns - back)
            self._seek(start / 1e9)
            self._first = next((timed for timed in self._coming if timed[0] is not None), None)
            if start == 0 or self._first is None or (self._first[0] or 0) <= t_ns + _ROUNDED_NS:
                return
            back = max(2 * back, _A_SECOND_NS)

    def _seek(self, seconds: float) -> None:
        """Go to the key frame whose picture is decoded at or before a time."""
        try:
            self._container.seek(int(seconds / self._unit), stream=self._stream, backward=True)
        except (FFmpegError, OverflowError) as error:
            raise self._bad(f"has nothing at {seconds:.3f} s") from error
        self._decoder = self._new_decoder(midway=True)
        self._coming, self._first = self._decoded(), None

    def _time(self, ticks: int) -> int:
        t_ns = round(ticks * self._unit * 1_000_000_000)
        if abs(t_ns) > _LATEST // 4:
            raise self._bad(f"has a picture at {t_ns / 1e9:.3g} s, a time that cannot be")
        return t_ns

    def _bad(self, reason: str) -> RecordingImportError:
        return RecordingImportError(f"the video {str(self.path)!r} {reason}.")


def _is_whole(file: BinaryIO, kind: str, size: int) -> bool:
    """Whether a file is as long as its outermost elements say."""
    file.seek(0)
    if kind == "mkv":
        return _matroska_end(file.read(256), size) <= size
    position = 0
    while position < size:
        file.seek(position)
        head = file.read(16)
        if len(head) < 8:
            return kind == "avi"  # a single byte or two: padding
        if kind == "avi":
            if head[:4] != b"RIFF":
                return True
            length = 8 + int.from_bytes(head[4:8], "little")
        else:
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            if length == 0:  # to the end of the file
                return True
        position += max(length, 8)
    return position <= size + (kind == "avi")


def _matroska_end(start: bytes, size: int) -> int:
    """Where the segment should end; the file's size where it does not say."""
    position = 0
    for name in (_EBML, _SEGMENT):
        if position + 12 > len(start) or start[position : position + 4] != name:
            return size
        position += 4
        width = 9 - start[position].bit_length()
        if width > 8:
            return size
        length = int.from_bytes(start[position : position + width], "big") & ((1 << 7 * width) - 1)
        if length == (1 << 7 * width) - 1:  # not known: a live stream
            return size
        position += width + length
    return position
