"""Video files and packets whose pictures are known, and what another decoder makes of a file."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream
from jaxtyping import UInt8

from dmotion_bench.storage.video.scheduling import as_scheduled_before

Frames = UInt8[np.ndarray, "t h w 3"]
LOSSLESS: Mapping[str, tuple[str, str, Mapping[str, str]]] = {
    "h264": ("libx264rgb", "rgb24", {"qp": "0", "g": "12"}),
    "hevc": ("libx265", "gbrp", {"x265-params": "lossless=1:bframes=3:b-adapt=0:keyint=12:log-level=none"}),
    "vp9": ("libvpx-vp9", "gbrp", {"lossless": "1", "g": "12"}),
    "ffv1": ("ffv1", "bgr0", {}),
    "raw": ("rawvideo", "bgr24", {}),
    "png": ("png", "rgb24", {}),
}
"""Encoders that keep every bit; hevc's pictures are sent in another order than that in which they are shown."""


def moving(count: int, height: int = 48, width: int = 64) -> Frames:
    """A square that moves over noise: every picture differs, and codecs predict one from the other."""
    frames = np.repeat(np.random.default_rng(0).integers(60, 120, (1, height, width, 3), dtype=np.uint8), count, axis=0)
    for number, frame in enumerate(frames):
        left = 3 * number % (width - 12)
        frame[8:20, left : left + 12] = (220, 40 + number % 100, 30)
    return frames


@as_scheduled_before()
def video_file(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "h w 3"]],
    kind: str = "h264",
    *,
    times: Sequence[float] | None = None,
    rate: int = 10,
    rotation: tuple[int, bool, bool] | None = None,
    pixel_aspect: Fraction | None = None,
    encoder: tuple[str, str, Mapping[str, str]] | None = None,
    form: str | None = None,
    options: Mapping[str, str] | None = None,
) -> Path:
    """A video file; the container is told by the path's suffix.

    Args:
        path: Of it.
        frames: Its pictures.
        kind: A key of ``LOSSLESS``.
        times: When each is shown [s]; steady by default.
        rate: Pictures a second.
        rotation: How it is to be shown: degrees, mirrored left-right, mirrored up-down.
        pixel_aspect: Width to height of a pixel as it is to be shown.
        encoder: Another one: FFmpeg's name, its pixels, its options.
        form: FFmpeg's name of the container, where the suffix does not tell.
        options: Of the container.
    """
    name, pixels, settings = encoder or LOSSLESS[kind]
    unit = Fraction(1, 1000) if times is not None else Fraction(1, rate)
    with av.open(str(path), "w", format=form, container_options=dict(options or {})) as container:
        stream: Any = None
        for number, picture in enumerate(frames):
            if stream is None:
                stream = container.add_stream(name, rate=rate, options=dict(settings))
                assert isinstance(stream, VideoStream)
                stream.height, stream.width, stream.pix_fmt = picture.shape[0], picture.shape[1], pixels
                stream.codec_context.time_base = unit
                if pixel_aspect is not None:
                    stream.codec_context.sample_aspect_ratio = pixel_aspect
                if rotation is not None:
                    stream.set_display_rotation(rotation[0], hflip=rotation[1], vflip=rotation[2])
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = number if times is None else round(times[number] * 1000), unit
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@as_scheduled_before()
def packets(frames: Frames, encoder: str, pixels: str, settings: Mapping[str, str]) -> list[bytes]:
    """What an encoder sends over a topic: one packet a picture, headers in the stream itself."""
    context = av.CodecContext.create(encoder, "w")
    assert isinstance(context, VideoCodecContext)
    context.height, context.width, context.pix_fmt = frames.shape[1], frames.shape[2], pixels
    context.time_base, context.framerate, context.options = Fraction(1, 10), Fraction(10), dict(settings)
    sent: list[bytes] = []
    for number, picture in enumerate(frames):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pixels)
        frame.pts = number
        sent += [bytes(packet) for packet in context.encode(frame)]
    return sent + [bytes(packet) for packet in context.encode(None)]


def by_ffmpeg(path: Path, height: int, width: int) -> Frames:
    """The pictures of a file as the program ``ffmpeg`` decodes them, with the same care for colours."""
    flags = "bicubic+accurate_rnd+full_chroma_int+bitexact"
    words = ["ffmpeg", "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-sws_flags", flags, "-"]
    told = subprocess.run(words, check=True, capture_output=True).stdout
    return np.frombuffer(told, np.uint8).reshape(-1, height, width, 3)
