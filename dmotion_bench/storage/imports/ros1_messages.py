"""Camera messages of ROS 1, as ``mcap convert`` keeps them of a bag: little-endian, without padding between fields.

The format is that of http://wiki.ros.org/roscpp/Overview/MessagesSerializationAndAdaptingTypes: texts and lists of
bytes have their length before them. A header is a number, a time in seconds and nanoseconds, and a text.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

from dmotion_bench.storage.imports.mcap_records import TopicInfo
from dmotion_bench.storage.imports.passed_over import CONVERTER

_HEADER: Final = struct.Struct("<III")  # its number, seconds, nanoseconds
_COUNT: Final = struct.Struct("<I")


def way_out(topic: TopicInfo) -> str:
    """A sentence that follows an error about a topic's messages: how those of ROS 1 can be read; empty for others."""
    if topic.message_encoding != "ros1":
        return ""
    return f" Of ROS 1 only the cameras can be read: make the file again from the bag itself with {CONVERTER}."


class _Fields:
    """A message, read from its beginning on; every length is held against what is there.

    Args:
        data: Of the message.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def count(self) -> int:
        """A whole number of 32 bits."""
        return int(_COUNT.unpack(self._exactly(_COUNT.size))[0])

    def byte(self) -> int:
        """A whole number of 8 bits."""
        return self._exactly(1)[0]

    def content(self) -> bytes:
        """A list of bytes."""
        return self._exactly(self.count())

    def text(self) -> str:
        """A text."""
        return self.content().decode(errors="replace")

    def header(self) -> dict[str, Any]:
        """The header of all messages of sensors."""
        _, seconds, nanoseconds = _HEADER.unpack(self._exactly(_HEADER.size))
        return {"stamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": self.text()}

    def end(self) -> None:
        """See that nothing is left."""
        if self._place != len(self._data):
            raise ValueError(f"{len(self._data) - self._place:,} bytes are left over")

    def _exactly(self, size: int) -> bytes:
        start, self._place = self._place, self._place + size
        if self._place > len(self._data):
            raise ValueError(f"{self._place - len(self._data):,} bytes are missing at its end")
        return self._data[start : self._place]


def image(data: bytes) -> dict[str, Any]:
    """The fields of a ``sensor_msgs/Image``.

    Raises:
        ValueError: The bytes are none.
    """
    fields = _Fields(data)
    message = {
        "header": fields.header(),
        "height": fields.count(),
        "width": fields.count(),
        "encoding": fields.text(),
        "is_bigendian": fields.byte(),
        "step": fields.count(),
        "data": fields.content(),
    }
    fields.end()
    return message


def compressed_image(data: bytes) -> dict[str, Any]:
    """The fields of a ``sensor_msgs/CompressedImage``.

    Raises:
        ValueError: The bytes are none.
    """
    fields = _Fields(data)
    message = {"header": fields.header(), "format": fields.text(), "data": fields.content()}
    fields.end()
    return message


ROS1_DECODERS: Final[Mapping[str, Callable[[bytes], dict[str, Any]]]] = MappingProxyType(
    {"sensor_msgs/Image": image, "sensor_msgs/CompressedImage": compressed_image}
)
"""What reads the messages of a type, by its name."""
