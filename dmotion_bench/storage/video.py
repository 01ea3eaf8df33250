"""MP4 through PyAV (FFmpeg), for LeRobot data sets: the only place where video codecs are met.

``H264`` in RGB planes without quantisation keeps every bit and is decoded by every FFmpeg; it is written with the
encoder ``libx264rgb``. ``AV1`` in YUV 4:2:0 is what LeRobot itself writes: smaller, lossy. PyAV is optional.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Self

import numpy as np
from jaxtyping import UInt8

from dmotion_bench.errors import PackageNotInstalled, RecordingImportError


@dataclass(frozen=True, kw_only=True)
class Codec:
    """How a video is encoded.

    Attributes:
        name: As ``--codec`` has it.
        encoder: FFmpeg's name of the encoder.
        decoder: FFmpeg's name of the format, as LeRobot's ``info.json`` has it.
        pixels: FFmpeg's name of the pixel format.
        stored: The pixel format that a decoder reports.
        options: Of the encoder; a key frame every other frame, as LeRobot has it, for random access.
    """

    name: str
    encoder: str
    decoder: str
    pixels: str
    stored: str
    options: Mapping[str, str]


H264 = Codec(
    name="h264",
    encoder="libx264rgb",
    decoder="h264",
    pixels="rgb24",
    stored="gbrp",
    options={"qp": "0", "preset": "medium", "g": "2"},
)
AV1 = Codec(
    name="av1",
    encoder="libsvtav1",
    decoder="av1",
    pixels="yuv420p",
    stored="yuv420p",
    options={"crf": "30", "preset": "12", "g": "2"},
)
CODECS = {codec.name: codec for codec in (H264, AV1)}


def pyav(why: str) -> ModuleType:
    """PyAV.

    Raises:
        PackageNotInstalled: It is not there.
    """
    try:
        import av
        import av.logging
    except ImportError as error:
        raise PackageNotInstalled("av", why, "pip install 'dmbench[lerobot]'") from error
    av.logging.set_level(av.logging.PANIC)
    module: ModuleType = av
    return module


class VideoReader:
    """The frames of an MP4 file, forward.

    Args:
        path: The file.
        pixels: More than so many pixels a frame are refused.

    Raises:
        RecordingImportError: It is no video, or too large.
    """

    def __init__(self, path: Path, *, pixels: int) -> None:
        self._av, self.path = pyav("reading a LeRobot data set"), path
        try:
            self._container = self._av.open(str(path), metadata_errors="ignore")
        except (self._av.error.FFmpegError, OSError) as error:
            raise RecordingImportError(f"{str(path)!r} is no video: {error}.") from error
        if not self._container.streams.video:
            self.close()
            raise RecordingImportError(f"{str(path)!r} holds no video.")
        self._stream = self._container.streams.video[0]
        self.height, self.width = int(self._stream.height), int(self._stream.width)
        if not 0 < self.height * self.width <= pixels:
            self.close()
            raise RecordingImportError(
                f"{str(path)!r} declares {self.width}x{self.height} pixels; {pixels:,} are allowed."
            )

    def frames(self, wanted: Sequence[int], fps: float) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Some frames.

        Args:
            wanted: Their numbers in the file, strictly ascending.
            fps: Frames a second: frame i stands at i / fps.

        Raises:
            RecordingImportError: The file is damaged or lacks one.
        """
        waiting = list(reversed(wanted))
        if not waiting:
            return
        unit = self._stream.time_base
        try:
            self._container.seek(round((waiting[-1] / fps) / float(unit)), stream=self._stream, backward=True)
            for frame in self._container.decode(self._stream):
                number = round(float(frame.pts * unit) * fps)
                if number < waiting[-1]:
                    continue
                if number > waiting[-1]:
                    break
                if (frame.height, frame.width) != (self.height, self.width):
                    raise RecordingImportError(f"{str(self.path)!r} changes its size at frame {number}.")
                yield frame.to_ndarray(format="rgb24")
                waiting.pop()
                if not waiting:
                    return
        except (self._av.error.FFmpegError, TypeError, OverflowError) as error:
            raise RecordingImportError(f"{str(self.path)!r} is damaged: {error}.") from error
        raise RecordingImportError(f"{str(self.path)!r} lacks frame {waiting[-1]}, which its data set lists.")

    def close(self) -> None:
        """Let go of the file."""
        self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class VideoWriter:
    """An MP4 file of frames at a steady rate; whole after ``close``.

    Attributes:
        count: Frames given so far.
        bytes: That the encoder has given back so far.
    """

    def __init__(self, path: Path, codec: Codec, *, fps: Fraction, height: int, width: int) -> None:
        av = pyav("writing a LeRobot data set")
        self._av, self._codec = av, codec
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream(codec.encoder, rate=fps, options=dict(codec.options))
        self._stream.height, self._stream.width, self._stream.pix_fmt = height, width, codec.pixels
        self._stream.codec_context.time_base = self._unit = 1 / fps
        self.count = self.bytes = 0

    def write(self, frames: UInt8[np.ndarray, "t h w 3"]) -> None:
        """Append frames."""
        for image in frames:
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = self.count, self._unit
            self._mux(self._stream.encode(frame))
            self.count += 1

    def close(self) -> None:
        """Write what the encoder still holds, and the file's head."""
        self._mux(self._stream.encode(None))
        self._container.close()

    def _mux(self, packets: Any) -> None:
        for packet in packets:
            self.bytes += packet.size
            self._container.mux(packet)
