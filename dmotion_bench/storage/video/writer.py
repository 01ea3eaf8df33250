"""Frames -> an MP4 file."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.packet import Packet
from av.video.stream import VideoStream
from jaxtyping import UInt8

from dmotion_bench.storage.video.codecs import Codec
from dmotion_bench.storage.video.scheduling import as_scheduled_before


class VideoWriter:
    """An MP4 file of frames at a steady rate; whole after ``close``.

    Attributes:
        count: Frames given so far.
        bytes: That the encoder has given back so far.
    """

    def __init__(self, path: Path, codec: Codec, *, fps: Fraction, height: int, width: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w")
        stream = self._container.add_stream(codec.encoder, rate=fps, options=dict(codec.options))
        assert isinstance(stream, VideoStream)
        self._stream = stream
        self._stream.height, self._stream.width, self._stream.pix_fmt = height, width, codec.pixels
        self._stream.codec_context.time_base = self._unit = 1 / fps
        self.count = self.bytes = 0

    def write(self, frames: UInt8[np.ndarray, "t h w 3"]) -> None:
        """Append frames."""
        for image in frames:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = self.count, self._unit
            self._mux(self._encoded(frame))
            self.count += 1

    def close(self) -> None:
        """Write what the encoder still holds, and the file's head."""
        self._mux(self._encoded(None))
        self._container.close()

    def _encoded(self, frame: av.VideoFrame | None) -> list[Packet[Any]]:
        if self._stream.codec_context.is_open:
            return self._stream.encode(frame)
        with as_scheduled_before():
            return self._stream.encode(frame)  # opens the encoder

    def _mux(self, packets: Iterable[Packet[Any]]) -> None:
        for packet in packets:
            self.bytes += packet.size
            self._container.mux(packet)
