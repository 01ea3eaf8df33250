"""Packets of one video stream -> the pictures that are whole, in the order in which they are shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from av.codec.context import CodecContext
from av.error import FFmpegError
from av.packet import Packet
from av.sidedata.sidedata import SideDataContainer, Type
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation
from jaxtyping import UInt8

FAITHFUL: Final = (
    Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.BITEXACT
)
"""FFmpeg's default rounds differently on every processor and makes pictures 1.3 of 255 too dark."""

DECODERS: Final = {"h264": "h264", "hevc": "hevc", "av1": "libdav1d", "vp9": "vp9", "vp8": "vp8", "mjpeg": "mjpeg"}
"""FFmpeg's decoder of each codec that comes without a container."""


class DamagedPicture(Exception):
    """A packet that gives no whole picture; the reason, for the sentence of the file's reader."""


class PictureStream:
    """One stream's decoder.

    A picture that is damaged is an error, or it is left out with all that follows it up to the next key frame, since
    those are drawn on top of it.

    Args:
        context: FFmpeg's decoder; it works in one thread, so that the same bytes give the same pictures.
        pixels: The decoder refuses larger pictures before it allocates them.
        salvage: Leave damaged pictures out.
        midway: The first packet may be one in the middle of a stream, which needs others before it: what comes before
            the first picture that can be decoded is left out and does not count as damaged.

    Attributes:
        damaged: Pictures left out so far.
    """

    def __init__(self, context: VideoCodecContext, *, pixels: int, salvage: bool, midway: bool) -> None:
        if not context.is_open:
            context.thread_count = 1
            context.options = decoder_options(pixels)
        self._context, self._salvage = context, salvage
        self._begun, self._lost, self.damaged = not midway, False, 0
        self._turn, self._seen = Turn(), False

    @classmethod
    def of_codec(cls, codec: str, *, pixels: int, salvage: bool) -> PictureStream:
        """A decoder for a topic's packets; ``codec`` is one of ``DECODERS``."""
        context = CodecContext.create(DECODERS[codec], "r")
        assert isinstance(context, VideoCodecContext)
        return cls(context, pixels=pixels, salvage=salvage, midway=True)

    def decode(self, packet: Packet[Any] | None) -> list[VideoFrame]:
        """The pictures that this packet completes; with None those that the decoder still holds.

        Raises:
            DamagedPicture: One of them is damaged, and damage is not to be lived with.
            MemoryError: It would take more memory than there is.
        """
        try:
            if packet is not None and packet.is_corrupt:
                self._damage("it is cut off")
                return []
            frames = self._context.decode(packet)
        except MemoryError:
            raise
        except FFmpegError as error:
            if self._begun:
                self._damage(str(error.strerror))
            return []
        return [frame for frame in frames if self._is_whole(frame)]

    def size(self, frame: VideoFrame) -> tuple[int, int]:
        """Height and width of a picture as it is shown."""
        return (frame.width, frame.height) if self._turn.flat else (frame.height, frame.width)

    def rgb(self, frame: VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """A picture's pixels, turned as the stream says.

        Raises:
            FFmpegError, ValueError: They cannot be made RGB.
        """
        pixels: UInt8[np.ndarray, "h w 3"] = frame.to_ndarray(format="rgb24", interpolation=FAITHFUL, threads=1)
        if self._turn.flat:
            pixels = pixels.swapaxes(0, 1)
        return np.ascontiguousarray(pixels[:: -1 if self._turn.down else 1, :: -1 if self._turn.across else 1])

    def _is_whole(self, frame: VideoFrame) -> bool:
        if frame.is_corrupt:
            if self._begun:
                self._damage("parts of it cannot be decoded")
            return False
        if self._lost and not frame.key_frame:
            self.damaged += 1
            return False
        if not self._seen:
            self._turn, self._seen = Turn.of(frame), True
        self._begun, self._lost = True, False
        return True

    def _damage(self, reason: str) -> None:
        if not self._salvage:
            raise DamagedPicture(f"is damaged: {reason}")
        self.damaged += 1
        self._lost = True


def decoder_options(pixels: int) -> dict[str, str]:
    """What keeps FFmpeg from allocating larger pictures, with room for the rows and columns that codecs add."""
    return {"max_pixels": str(2 * pixels + (1 << 16))}


@dataclass(frozen=True, kw_only=True)
class Turn:
    """How a stream's pictures are to be shown: its display matrix, to a quarter turn.

    Attributes:
        flat: Rows and columns change places first.
        across, down: Then it is mirrored left-right, up-down.
    """

    flat: bool = False
    across: bool = False
    down: bool = False

    @classmethod
    def of(cls, frame: VideoFrame) -> Turn:
        """What a stream's first picture says; PyAV keeps a picture whose side data was asked for, so only that one."""
        try:
            matrix = cast("SideDataContainer", frame.side_data)[Type.DISPLAYMATRIX]
        except KeyError:
            return cls()
        a, b, _, c, d = np.frombuffer(bytes(matrix), "<i4", count=5).tolist()
        if abs(b) + abs(c) > abs(a) + abs(d):
            return cls(flat=True, across=c < 0, down=b < 0)
        return cls(across=a < 0, down=d < 0)
