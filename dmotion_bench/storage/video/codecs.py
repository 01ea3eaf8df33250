"""The codecs that a data set is exported with.

``H264`` in RGB planes without quantisation keeps every bit and is decoded by every FFmpeg; it is written with the
encoder ``libx264rgb``. ``AV1`` in YUV 4:2:0 is what LeRobot itself writes: smaller, lossy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


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
