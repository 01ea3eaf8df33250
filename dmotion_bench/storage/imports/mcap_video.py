"""An MCAP file whose camera sends a video, a packet in each message: H.264, H.265, AV1, VP9 or VP8.

A picture is drawn on top of those before it, so all of the video is decoded, in the survey and again for the pictures.
What stands before the first picture that can be decoded, since the recording began in the middle of the video, is left
out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from av.error import FFmpegError
from av.packet import Packet
from av.video.frame import VideoFrame
from jaxtyping import Int64, UInt8

from dmotion_bench.storage.imports.cameras import Picture, VideoPacket, picture_decoder
from dmotion_bench.storage.imports.mcap_recording import McapRecording, Size
from dmotion_bench.storage.imports.mcap_records import TopicInfo
from dmotion_bench.storage.imports.recording import Clock
from dmotion_bench.storage.imports.sent_pictures import Times, as_shown, pictures_kept, skips
from dmotion_bench.storage.imports.two_clocks import apart_s, is_ascending
from dmotion_bench.storage.video.h264_numbers import PictureNumbers
from dmotion_bench.storage.video.stream import DamagedPicture, PictureStream
from dmotion_bench.wording import counted


class McapVideo(McapRecording):
    """One MCAP file; arguments and errors as for ``McapRecording``."""

    _stream: PictureStream | None = None
    _codec = ""
    _numbers: PictureNumbers | None = None
    _lost = 0
    _is_key: list[bool]  # of each picture, in a survey

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Decode the video up to the last wanted picture."""
        self._stream = None
        numbers = iter(wanted.tolist())
        number = next(numbers, None)
        for count, (message, frame, stream) in enumerate(self._frames()):
            if number is None:
                return
            if count == number:
                try:
                    yield stream.rgb(frame)
                except (FFmpegError, ValueError) as error:
                    raise self._bad(message, self._camera, f"cannot be made RGB: {str(error)[:120]}") from error
                number = next(numbers, None)
        if number is not None:
            raise self._changed()

    def _frames(self) -> Iterator[tuple[int, VideoFrame, PictureStream]]:
        decoders: dict[TopicInfo, Callable[[bytes], Any]] = {}
        for count, message in self._camera_messages():
            yield from self._fed(self._decode(message, count, decoders, picture_decoder), count)
        yield from self._fed(None, -1)

    def _look(self, picture: Picture, number: int) -> Iterator[tuple[int, Size]]:
        if number == 0:
            self._stream, self._numbers, self._lost, self._is_key = None, PictureNumbers(), 0, list[bool]()
        if self._numbers is not None and isinstance(picture, VideoPacket) and picture.codec == "h264":
            self._lost += self._numbers.is_one_lost(picture.data)
        yield from self._seen(picture, number)

    def _look_on(self) -> Iterator[tuple[int, Size]]:
        yield from self._seen(None, -1)
        self.unreadable = self._stream.damaged if self._stream is not None else 0

    def _seen(self, picture: Picture | None, number: int) -> Iterator[tuple[int, Size]]:
        for message, frame, stream in self._fed(picture, number):
            self._is_key.append(frame.key_frame)
            yield message, stream.size(frame)

    def _in_order(self, times_ns: Times, others_ns: Times, numbers: Times, lengths: Times) -> tuple[Times, Times]:
        """Both clocks as the times of the pictures, which may come in another order than they are shown in."""
        taken, others = as_shown(times_ns, numbers), as_shown(others_ns, numbers)
        self._told_of_order = []
        if taken is not times_ns:
            has_own = self._clock is Clock.LOG and is_ascending(others_ns)
            is_other = self._actions is not None and apart_s(taken, others) is not None
            own = " The camera's own time stamps tell more: use '--clock header'." if has_own and not is_other else ""
            self._told_of_order = [
                f"the video on {self._camera!r} has B-frames: some pictures are sent before others that are shown "
                "earlier. The times of the messages count for the pictures in turn, "
                f"{counted(pictures_kept(numbers), 'picture')} earlier, as the encoder waited for so many at least."
                f"{own}"
            ]
        return taken, others

    def _told_of_video(self, times_ns: Times, others_ns: Times) -> list[str]:
        if self._codec == "h264":
            if not self._lost:
                return []
            return [
                f"messages on {self._camera!r} were lost before they were recorded, in "
                f"{counted(self._lost, 'place')}: the pictures after them, up to the next key frame, are drawn on top "
                "of lost ones and look wrong. Look at them before you train."
            ]
        stamps_ns = others_ns if self._clock is Clock.LOG and is_ascending(others_ns) else times_ns
        if not (missing := skips(stamps_ns, np.array(self._is_key))):
            return []
        return [
            f"by its times the video on {self._camera!r} lacks pictures in {counted(missing, 'place')}: if their "
            "messages were lost, the pictures after them, up to the next key frame, are drawn on top of lost ones and "
            "may look wrong. Look at them before you train."
        ]

    def _fed(self, picture: Picture | None, number: int) -> Iterator[tuple[int, VideoFrame, PictureStream]]:
        """The pictures that a message completes, each with the number of its own message and what decoded it."""
        packet = None
        if picture is not None:
            if not isinstance(picture, VideoPacket):
                raise self._bad(number, self._camera, "is a picture among packets of video")
            if self._stream is None:
                self._codec = picture.codec
                pixels = self._limits.pixels
                self._stream = PictureStream.of_codec(picture.codec, pixels=pixels, salvage=self._salvage)
            if picture.codec != self._codec:
                raise self._bad(number, self._camera, f"is {picture.codec} among {self._codec}")
            if not picture.data:
                return
            packet = Packet(picture.data)
            packet.pts = number
        if self._stream is None:
            return
        try:
            frames = self._stream.decode(packet)
        except DamagedPicture as error:
            way_out = "import the others with '--salvage'"
            raise self._bad(number, self._camera, f"{error}; {way_out}") from error
        for frame in frames:
            if frame.height * frame.width > self._limits.pixels:
                raise self._bad(number, self._camera, f"is {frame.width}x{frame.height} pixels large")
            yield number if frame.pts is None else frame.pts, frame, self._stream
