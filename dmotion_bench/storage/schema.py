"""What the messages of a data set look like: topics, protobuf types, and the descriptors embedded in the files.

``/camera`` and ``/masks`` are ``foxglove.RawImage``, so that Rerun and Foxglove draw them; the states are
``dmbench.States``, made of Foxglove's poses. The descriptors stand here, field by field, instead of being taken
from the installed Foxglove package: the bytes of a data set must not change when that package is upgraded.
(A test compares them with the package's.)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from dmotion_bench.actions import ActionSpec, Continuous

CAMERA_TOPIC: Final = "/camera"
ACTION_TOPIC: Final = "/action"
AGENT_TOPIC: Final = "/agent"
OBJECTS_TOPIC: Final = "/objects"
MASKS_TOPIC: Final = "/masks"
FACTORS_TOPIC: Final = "/factors"

_TIMESTAMP = ("timestamp", 1, ".google.protobuf.Timestamp")
_FILES: Final[dict[str, tuple[str, dict[str, tuple[tuple[str, int, str], ...]]]]] = {
    "google/protobuf/timestamp.proto": (
        "google.protobuf",
        {"Timestamp": (("seconds", 1, "int64"), ("nanos", 2, "int32"))},
    ),
    "foxglove/RawImage.proto": (
        "foxglove",
        {
            "RawImage": (
                _TIMESTAMP,
                ("frame_id", 7, "string"),
                ("width", 2, "fixed32"),
                ("height", 3, "fixed32"),
                ("encoding", 4, "string"),
                ("step", 5, "fixed32"),
                ("data", 6, "bytes"),
            )
        },
    ),
    "foxglove/Vector3.proto": (
        "foxglove",
        {"Vector3": (("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double"))},
    ),
    "foxglove/Quaternion.proto": (
        "foxglove",
        {"Quaternion": (("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double"), ("w", 4, "double"))},
    ),
    "foxglove/Pose.proto": (
        "foxglove",
        {"Pose": (("position", 1, ".foxglove.Vector3"), ("orientation", 2, ".foxglove.Quaternion"))},
    ),
    "foxglove/Point2.proto": ("foxglove", {"Point2": (("x", 1, "double"), ("y", 2, "double"))}),
    "dmbench/labels.proto": (
        "dmbench",
        {
            "Action": (_TIMESTAMP, ("action", 2, "int32"), ("name", 3, "string"), ("pushed", 4, "bool")),
            "State": (
                ("name", 1, "string"),
                ("pose", 2, ".foxglove.Pose"),  # [m]
                ("pixel", 3, ".foxglove.Point2"),  # [px]
                ("visible", 4, "double"),
            ),
            "States": (_TIMESTAMP, ("states", 2, "repeated .dmbench.State")),
            "Factors": (_TIMESTAMP, ("json", 2, "string")),
        },
    ),
    "dmbench/continuous_action.proto": (
        "dmbench",
        {"ContinuousAction": (_TIMESTAMP, ("values", 2, "repeated double"), ("pushed", 3, "bool"))},
    ),
}
"""File -> (package, message -> (field, number, type)); a type with a dot names a message."""


def _file(name: str) -> FileDescriptorProto:
    package, messages = _FILES[name]
    file = FileDescriptorProto(name=name, package=package, syntax="proto3")
    file.dependency.extend(_dependencies(name))
    for message_name, fields in messages.items():
        message = file.message_type.add(name=message_name)
        for field_name, number, kind in fields:
            repeated, _, kind = kind.rpartition(" ")
            field = message.field.add(name=field_name, number=number)
            field.label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
            if kind.startswith("."):
                field.type, field.type_name = FieldDescriptorProto.TYPE_MESSAGE, kind
            else:
                field.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
    return file


def _dependencies(name: str) -> list[str]:
    """The files that define the messages which a file's fields name, in alphabetical order."""
    home = {f".{package}.{message}": file for file, (package, messages) in _FILES.items() for message in messages}
    kinds = {kind.rpartition(" ")[2] for fields in _FILES[name][1].values() for _, _, kind in fields}
    return sorted({home[kind] for kind in kinds if kind.startswith(".")} - {name})


def _closure(name: str) -> Iterable[str]:
    """A file and all it needs, dependencies first."""
    for needed in _dependencies(name):
        yield from _closure(needed)
    yield name


@dataclass(frozen=True)
class MessageType:
    """A protobuf type as an MCAP file names it.

    Attributes:
        name: Full name, such as ``"foxglove.RawImage"``.
        descriptors: The serialised ``FileDescriptorSet`` that defines it.
        new: Builds a message; keyword arguments set its fields.
    """

    name: str
    descriptors: bytes
    new: Any


_POOL = DescriptorPool()
for _name in _FILES:
    _POOL.Add(_file(_name))


def _message_type(file: str, name: str) -> MessageType:
    needed = list(dict.fromkeys(_closure(file)))
    descriptors = FileDescriptorSet(file=[_file(one) for one in needed]).SerializeToString(deterministic=True)
    return MessageType(name, descriptors, GetMessageClass(_POOL.FindMessageTypeByName(name)))


RAW_IMAGE: Final = _message_type("foxglove/RawImage.proto", "foxglove.RawImage")
ACTION: Final = _message_type("dmbench/labels.proto", "dmbench.Action")
CONTINUOUS_ACTION: Final = _message_type("dmbench/continuous_action.proto", "dmbench.ContinuousAction")
STATES: Final = _message_type("dmbench/labels.proto", "dmbench.States")
FACTORS: Final = _message_type("dmbench/labels.proto", "dmbench.Factors")

VIDEO_CHANNELS: Final = ((CAMERA_TOPIC, RAW_IMAGE),)
LABEL_CHANNELS: Final = (
    (ACTION_TOPIC, ACTION),
    (AGENT_TOPIC, STATES),
    (OBJECTS_TOPIC, STATES),
    (FACTORS_TOPIC, FACTORS),
    (MASKS_TOPIC, RAW_IMAGE),
)
"""The channels of the two kinds of file, in the order of their numbers, which start at 1."""


def label_channels(actions: ActionSpec | None) -> tuple[tuple[str, MessageType], ...]:
    """``LABEL_CHANNELS`` with the type that these actions have."""
    kind = CONTINUOUS_ACTION if isinstance(actions, Continuous) else ACTION
    return tuple((topic, kind if one is ACTION else one) for topic, one in LABEL_CHANNELS)
