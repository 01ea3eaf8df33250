"""Camera messages of foxglove and ROS, in CDR, protobuf or JSON -> pictures or packets of video, not yet unpacked.

ROS messages are decoded by their published definitions (those below, ``ros1_messages``), not by the text a file
carries: a schema from elsewhere is a program for the decoder, and the well-known ones never differ.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.mcap_records import TopicInfo
from dmotion_bench.storage.imports.ros1_messages import ROS1_DECODERS, way_out

_HEADER = """std_msgs/Header header
{fields}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""

ROS_DEFINITIONS = {
    "sensor_msgs/Image": _HEADER.format(
        fields="uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "sensor_msgs/CompressedImage": _HEADER.format(fields="string format\nuint8[] data"),
    "foxglove_msgs/RawImage": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\n"
        "string encoding\nuint32 step\nuint8[] data\n"
    ),
    "foxglove_msgs/CompressedImage": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "foxglove_msgs/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "ffmpeg_image_transport_msgs/FFMPEGPacket": _HEADER.format(
        fields="int32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data"
    ),
}
RAW = frozenset({"sensor_msgs/Image", "foxglove_msgs/RawImage", "foxglove.RawImage"})
COMPRESSED = frozenset({"sensor_msgs/CompressedImage", "foxglove_msgs/CompressedImage", "foxglove.CompressedImage"})
VIDEO = frozenset(
    {"foxglove.CompressedVideo", "foxglove_msgs/CompressedVideo", "ffmpeg_image_transport_msgs/FFMPEGPacket"}
)
CAMERAS = RAW | COMPRESSED | VIDEO
_FOXGLOVE = frozenset(name for name in CAMERAS if name.startswith("foxglove."))
_CODECS = {
    "h264": ("h264", "x264", "avc"),
    "hevc": ("h265", "hevc", "x265"),
    "av1": ("av1",),
    "vp9": ("vp9",),
    "vp8": ("vp8",),
}
"""What an encoder's or format's name has in it, by FFmpeg's name of the codec."""


KNOWN = (
    "known are foxglove.RawImage, foxglove.CompressedImage, foxglove.CompressedVideo, sensor_msgs/msg/Image, "
    "sensor_msgs/msg/CompressedImage and ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
)


class BadPicture(Exception):
    """A camera message that is no picture; the reason, for the sentence of the file's reader."""


@dataclass(frozen=True, slots=True)
class RawPicture:
    """Uncompressed pixels as they stand in a message.

    Attributes:
        stamp_ns: When the camera says it took it, 0 where it does not.
        step: Bytes of a row.
        frame_id: What the camera calls its place, empty where it does not.
    """

    stamp_ns: int
    width: int
    height: int
    encoding: str
    step: int
    big_endian: bool
    data: bytes
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class CompressedPicture:
    """A JPEG, PNG or WebP file within a message."""

    stamp_ns: int
    format: str
    data: bytes
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class VideoPacket:
    """What one message of a video topic holds: a picture, drawn on top of those before it."""

    stamp_ns: int
    codec: str
    data: bytes
    frame_id: str = ""


Picture = RawPicture | CompressedPicture | VideoPacket
PictureDecoder = Callable[[bytes], Picture]


def well_known(topic: TopicInfo) -> str:
    """The message's name without ROS 2's ``/msg/``: ``"sensor_msgs/Image"``, ``"foxglove.RawImage"``."""
    return topic.schema_name.replace("/msg/", "/")


def is_camera(topic: TopicInfo) -> bool:
    """Whether the topic's messages are pictures that can be imported."""
    return well_known(topic) in CAMERAS


def codec_of(form: str) -> str | None:
    """The codec that a message's format names, ``"h264;yuv420p;bgr8"`` or ``"libx264"``; None for a picture's."""
    name = form.partition(";")[0].lower()
    return next((codec for codec, parts in _CODECS.items() if any(part in name for part in parts)), None)


def picture_decoder(topic: TopicInfo) -> PictureDecoder:
    """What turns the topic's messages into pictures; it raises ``BadPicture``.

    Raises:
        RecordingImportError: The messages are no pictures, or written in a way that is not known.
    """
    name = well_known(topic)
    if name not in CAMERAS:
        raise RecordingImportError(
            f"{topic.topic!r} carries {topic.schema_name or 'messages without a schema'}, not pictures; {KNOWN}."
        )
    decode = message_decoder(topic)
    build = _raw if name in RAW else _compressed if name in COMPRESSED else _video

    def picture(data: bytes) -> Picture:
        fields = decode(data)
        try:
            return build(fields)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise BadPicture(f"is no {name}: {error}") from error

    return picture


def message_decoder(topic: TopicInfo) -> Callable[[bytes], Any]:
    """What turns a well-known message into an object or a dictionary with its fields; raises ``BadPicture``.

    Raises:
        RecordingImportError: The messages are written in a way that is not known.
    """
    name = well_known(topic)
    if topic.message_encoding == "cdr" and name in ROS_DEFINITIONS:
        decode = ros_decoder(name, ROS_DEFINITIONS[name])
    elif topic.message_encoding == "protobuf" and name in _FOXGLOVE:
        decode = _foxglove_decoder(name)
    elif topic.message_encoding == "json":
        decode = json.loads
    elif topic.message_encoding == "ros1" and name in ROS1_DECODERS:
        decode = ROS1_DECODERS[name]
    else:
        raise RecordingImportError(
            f"{topic.topic!r} carries {topic.schema_name} written as {topic.message_encoding[:40]!r}; "
            f"known are 'cdr' for ROS 2 messages, 'ros1' for sensor_msgs, 'protobuf' for foxglove's, and 'json' for "
            f"either.{way_out(topic)}"
        )
    return guarded(decode, name)


def guarded(decode: Callable[[bytes], Any], name: str) -> Callable[[bytes], Any]:
    """The decoder with one kind of error, whatever the bytes do to it."""
    import struct

    from google.protobuf.message import DecodeError

    def decoded(data: bytes) -> Any:
        try:
            return decode(data)
        except (
            ValueError,
            IndexError,
            struct.error,
            DecodeError,
            RecursionError,
            OverflowError,
            NotImplementedError,
        ) as error:
            raise BadPicture(f"cannot be decoded as {name}: {str(error)[:120]}") from error

    return decoded


def ros_decoder(name: str, definition: str) -> Callable[[bytes], Any]:
    """A decoder of CDR by a message definition."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    schema = Schema(id=1, name=name, encoding="ros2msg", data=definition.encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    return decode


def _foxglove_decoder(name: str) -> Callable[[bytes], Any]:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    messages: dict[str, Any] = {
        "foxglove.RawImage": RawImage,
        "foxglove.CompressedImage": CompressedImage,
        "foxglove.CompressedVideo": CompressedVideo,
    }
    decode: Callable[[bytes], Any] = messages[name].FromString
    return decode


def _raw(message: Any) -> RawPicture:
    return RawPicture(
        stamp_ns=_stamp(message),
        width=_count(message, "width"),
        height=_count(message, "height"),
        encoding=_text(message, "encoding"),
        step=_count(message, "step"),
        big_endian=bool(_field(message, "is_bigendian", False)),
        data=_bytes(message),
        frame_id=_frame_id(message),
    )


def _compressed(message: Any) -> CompressedPicture | VideoPacket:
    form = _text(message, "format")
    codec = codec_of(form)
    if codec is not None:
        return VideoPacket(stamp_ns=_stamp(message), codec=codec, data=_bytes(message), frame_id=_frame_id(message))
    return CompressedPicture(stamp_ns=_stamp(message), format=form, data=_bytes(message), frame_id=_frame_id(message))


def _video(message: Any) -> VideoPacket:
    form = _text(message, "encoding" if _has(message, "encoding") else "format")
    codec = codec_of(form)
    if codec is None:
        raise ValueError(f"its format is {form[:40]!r}; known are {', '.join(_CODECS)}")
    return VideoPacket(stamp_ns=_stamp(message), codec=codec, data=_bytes(message), frame_id=_frame_id(message))


_MISSING = object()


def _field(message: Any, name: str, default: Any = _MISSING) -> Any:
    """A field of a decoded message, be it an object (CDR, protobuf) or a dictionary (JSON)."""
    found = message.get(name, default) if isinstance(message, dict) else getattr(message, name, default)
    if found is _MISSING:
        raise ValueError(f"it has no field {name!r}")
    return found


def _count(message: Any, name: str) -> int:
    number = _field(message, name)
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < 2**32:
        raise ValueError(f"its {name} is {str(number)[:40]!r}, no number of pixels or bytes")
    return number


def _text(message: Any, name: str) -> str:
    text = _field(message, name)
    if not isinstance(text, str):
        raise ValueError(f"its {name} is no text")  # noqa: TRY004 (of the file's content, not of a caller)
    return text


def _bytes(message: Any) -> bytes:
    data = _field(message, "data")
    if isinstance(data, str):
        return base64.b64decode(data, validate=True)
    return bytes(data) if isinstance(data, list) else memoryview(data).tobytes()


def _stamp(message: Any) -> int:
    """The message's own time [ns], 0 where it has none."""
    stamp = _field(message, "timestamp", None) or _field(_field(message, "header", None), "stamp", None)
    if stamp is None:
        return 0
    seconds = next((_field(stamp, name, None) for name in ("sec", "seconds") if _has(stamp, name)), 0)
    nanoseconds = next((_field(stamp, name, None) for name in ("nsec", "nanosec", "nanos") if _has(stamp, name)), 0)
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        raise ValueError("its time stamp is no time")  # noqa: TRY004 (of the file's content, not of a caller)
    return max(0, seconds * 1_000_000_000 + nanoseconds)


def _frame_id(message: Any) -> str:
    """What the camera calls its place, empty where it does not."""
    told = _field(message, "frame_id", None) or _field(_field(message, "header", None), "frame_id", None)
    return told if isinstance(told, str) else ""


def _has(message: Any, name: str) -> bool:
    return name in message if isinstance(message, dict) else hasattr(message, name)
