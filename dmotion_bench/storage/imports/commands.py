"""Action messages -> the discrete action in force at each frame.

An action is a choice out of a few: an integer, a truth value or a word, as ``std_msgs/Int32``, ``UInt8``,
``Bool``, ``String`` ..., as JSON, or as a protobuf message with one such field. Measurements (velocities,
joint positions) become continuous actions where somebody names their fields; see ``continuous_commands``.

A command holds until the next one. The action of frame i is the command in force halfway between frames i and
i + 1: so it counts whether the robot's program logs it just before the picture or just after. A command that comes
exactly halfway is in force already, however its time was rounded.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from jaxtyping import Bool, Int64

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture, guarded, ros_decoder, well_known
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands
from dmotion_bench.storage.imports.mcap_records import TopicInfo
from dmotion_bench.storage.imports.ros1_messages import way_out
from dmotion_bench.storage.imports.timeline import ROUNDED_NS

FIELDS: Final = ("action", "data", "value")
LONGEST: Final = 100  # characters of an action's name
_INTEGERS: Final = {f"{sign}Int{bits}": f"{sign.lower()}int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
_STANDARD: Final = {**_INTEGERS, "Bool": "bool", "Byte": "byte", "Char": "uint8", "String": "string"}
ROS_COMMANDS: Final = {f"std_msgs/{name}": f"{kind} data\n" for name, kind in _STANDARD.items()}


@dataclass(frozen=True, kw_only=True)
class DiscreteCommands:
    """The commands of a recording that are choices out of a few, in time order.

    Attributes:
        times_ns: When each was given.
        names: What it was, as text.
        vocabulary: All names that there are, in the order of their numbers, where the recording says so.
    """

    times_ns: Int64[np.ndarray, " n"]
    names: Sequence[str]
    vocabulary: Sequence[str] = ()


Commands = DiscreteCommands | ContinuousCommands


class EmptyCommand(BadPicture):
    """A message that holds no command where one is needed.

    Args:
        number: Of the message on its topic.
        reason: What it holds, to follow the message's number.
    """

    def __init__(self, number: int, reason: str) -> None:
        super().__init__(reason)
        self.number = number


def first_needed(times_ns: Int64[np.ndarray, " n"], is_whole: Bool[np.ndarray, " n"], last_ns: int) -> int | None:
    """The place of the first message without a command that some step would need; None if there is none.

    Before the first command nothing is commanded, and what is commanded at the last picture or later leads to none. All
    are needed if no message holds a command.

    Args:
        times_ns: Of the messages, in the order of the file.
        is_whole: Whether they hold commands.
        last_ns: When the last picture was taken.
    """
    if not is_whole.any():
        return 0 if len(times_ns) else None
    needed = ~is_whole & (times_ns >= times_ns[is_whole].min()) & (times_ns < last_ns)
    return int(needed.argmax()) if needed.any() else None


def command_decoder(topic: TopicInfo) -> Callable[[bytes], str]:
    """The function that turns a topic's messages into names of actions; it raises ``BadPicture`` for a bad message.

    The name is empty where the message holds nothing: no text, null in JSON, a number that is none.

    Raises:
        RecordingImportError: The messages cannot be discrete actions.
    """
    name = well_known(topic)
    if topic.message_encoding == "cdr" and name in ROS_COMMANDS:
        decode = guarded(ros_decoder(name, ROS_COMMANDS[name]), name)
    elif topic.message_encoding == "json":
        import json

        decode = guarded(json.loads, name or "JSON")
    elif topic.message_encoding == "protobuf":
        decode = guarded(protobuf_decoder(topic), name)
    else:
        raise RecordingImportError(
            f"{topic.topic!r} carries {topic.schema_name or 'messages without a schema'} written as "
            f"{topic.message_encoding[:40]!r}, no discrete actions; known are std_msgs/msg/Int*, UInt*, Bool and "
            "String, JSON like {\"action\": 2}, and protobuf with a field 'action', 'data' or 'value'. "
            "For continuous actions name the fields with their numbers, such as '--action-fields linear.x,angular.z'; "
            "to import the video alone, leave '--actions' out."
            f"{way_out(topic)}"
        )

    def name_in(data: bytes) -> str:
        value = _value(decode(data))
        return "" if _is_nothing(value) else action_name(value)

    return name_in


class CommandsReader(Protocol):
    """Collects the commands of a topic, message by message."""

    @property
    def count(self) -> int:
        """Of the commands so far."""

    def decoder(self, topic: TopicInfo) -> Callable[[bytes], Any]:
        """What turns the topic's messages into commands; it raises ``BadPicture`` for a bad message.

        Raises:
            RecordingImportError: The messages cannot be such commands.
        """

    def add(self, t_ns: int, command: Any) -> None:
        """Take a decoded command."""

    def collected(self, last_ns: int) -> Commands:
        """All commands so far, in the order of their times, without messages that hold none and that no step needs.

        Args:
            last_ns: When the last picture was taken.

        Raises:
            EmptyCommand: A message between the first command and the last picture holds none.
            BadPicture: No message holds a command.
        """

    @property
    def others(self) -> int:
        """Messages on the topic that hold none of what was asked for, and do not count."""


class DiscreteReader:
    """A ``CommandsReader`` of choices out of a few."""

    def __init__(self) -> None:
        self._times, self._names = array("q"), list[str]()
        self._known: dict[str, str] = {}

    @property
    def count(self) -> int:
        """Of the commands so far."""
        return len(self._times)

    def decoder(self, topic: TopicInfo) -> Callable[[bytes], str]:
        """See ``command_decoder``."""
        return command_decoder(topic)

    def add(self, t_ns: int, command: str) -> None:
        """Take a decoded command."""
        self._times.append(t_ns)
        self._names.append(self._known.setdefault(command, command))

    def collected(self, last_ns: int) -> DiscreteCommands:
        """All commands so far, in the order of their times; see ``CommandsReader``.

        Raises:
            EmptyCommand: A message holds no action where one is needed.
        """
        times = np.array(self._times, np.int64)
        is_whole = np.array([bool(name) for name in self._names], bool)
        if (place := first_needed(times, is_whole, last_ns)) is not None:
            raise EmptyCommand(
                place,
                "holds nothing, which is no choice out of a few; cut the recording before it, or import the video "
                "alone by leaving '--actions' out",
            )
        order = np.argsort(times, kind="stable")
        kept = order[is_whole[order]]
        return DiscreteCommands(times_ns=times[kept], names=[self._names[number] for number in kept.tolist()])

    @property
    def others(self) -> int:
        """None: every message must hold a command."""
        return 0


def action_name(value: Any) -> str:
    """An action's name.

    Raises:
        BadPicture: It is no choice out of a few.
    """
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, str) and 0 < len(value) <= LONGEST and value.isprintable():
        return value
    raise BadPicture(
        f"holds {str(value)[:60]!r}, a measurement and no choice out of a few; for continuous actions name the fields "
        "with their numbers in '--action-fields', or import the video alone by leaving '--actions' out"
    )


def from_choices(
    rows: Sequence[Any], times_ns: Int64[np.ndarray, " n"], vocabulary: Sequence[str] = ()
) -> DiscreteCommands:
    """The commands of a format that keeps them as a table.

    Args:
        rows: One for each picture, of which the last may be empty, or one less: the last leads to no picture.
        times_ns: When each picture was taken.
        vocabulary: See ``DiscreteCommands``; a row may hold the number of a name.

    Raises:
        BadPicture: A row is no choice out of a few.
    """
    single = [row[0] if isinstance(row, list) and len(row) == 1 else row for row in rows]
    if len(single) == len(times_ns) and single and _is_nothing(single[-1]):
        single.pop()
    names = []
    for name in map(action_name, single):
        number = int(name) if name.isdecimal() else -1
        names.append(vocabulary[number] if 0 <= number < len(vocabulary) else name)
    return DiscreteCommands(times_ns=times_ns[: len(names)], names=names, vocabulary=vocabulary)


def ordered_names(recordings: Sequence[DiscreteCommands], most: int) -> tuple[str, ...]:
    """Every name once: as the recordings order them; where they do not, integers by value, then words by the alphabet.

    Raises:
        RecordingImportError: There are more than ``most``.
    """
    given = list(dict.fromkeys(name for commands in recordings for name in commands.vocabulary))
    others = {name for commands in recordings for name in set(commands.names)}.difference(given)
    distinct = [*given, *sorted(others, key=lambda name: (0, int(name), name) if _is_integer(name) else (1, 0, name))]
    if len(distinct) > most:
        raise RecordingImportError(
            f"the actions take {len(distinct)} different values, more than the {most} that choices can have; bin them "
            "first, or import the video alone by leaving '--actions' out."
        )
    return tuple(distinct)


def in_force(commands: Commands, t_ns: Int64[np.ndarray, " t"]) -> Int64[np.ndarray, " t-1"]:
    """The number of the command in force halfway between each two ticks, -1 before the first command."""
    halfway = t_ns[:-1] + np.diff(t_ns) // 2 + ROUNDED_NS
    latest: Int64[np.ndarray, " t-1"] = np.searchsorted(commands.times_ns, halfway, side="right").astype(np.int64) - 1
    return latest


def _is_integer(name: str) -> bool:
    return name.removeprefix("-").isdecimal() and name.isascii()


def _is_nothing(value: Any) -> bool:
    """Whether a value says that there is no action."""
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))


def _value(message: Any) -> Any:
    """The one field that says the action, or the message itself where it is a bare value."""
    if isinstance(message, str | int | float | list):
        return message
    for field in FIELDS:
        if isinstance(message, dict):
            if field in message:
                return message[field]
        elif hasattr(message, field) and (not is_protobuf(message) or field in fields_given(message)):
            return getattr(message, field)
    raise BadPicture(
        f"has none of the fields {', '.join(FIELDS)}; for continuous actions name the fields with their numbers in "
        "'--action-fields', or import the video alone by leaving '--actions' out"
    )


def is_protobuf(message: Any) -> bool:
    """Whether a decoded message is one of protobuf."""
    return hasattr(type(message), "DESCRIPTOR")


def fields_given(message: Any) -> list[str]:
    """The fields of a protobuf message that have a value.

    A number that is not sent is 0, but not within a ``oneof``, of which one field at most was meant, nor where proto3
    calls it ``optional``, which is a ``oneof`` of a single field: protobuf would read zeros that nobody commanded.
    """
    sent = {field.name for field, _ in message.ListFields()}
    described = message.DESCRIPTOR.fields
    return [one.name for one in described if one.name in sent or not (one.message_type or one.containing_oneof)]


def protobuf_decoder(topic: TopicInfo) -> Callable[[bytes], Any]:
    """A decoder by the schema in the file.

    Raises:
        RecordingImportError: The schema cannot be used.
    """
    from google.protobuf.message import DecodeError
    from mcap.exceptions import McapError
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(id=1, name=topic.schema_name, encoding=topic.schema_encoding, data=topic.schema)
    try:
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, TypeError, ValueError, KeyError, RecursionError) as error:
        raise RecordingImportError(
            f"{topic.topic!r} carries protobuf messages whose schema cannot be used: {str(error)[:120]}."
        ) from error
    if decode is None:
        raise RecordingImportError(f"{topic.topic!r} carries protobuf messages without a protobuf schema.")
    return decode
