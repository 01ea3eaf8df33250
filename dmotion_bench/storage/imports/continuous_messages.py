"""Messages of any kind -> the numbers in some of their fields.

A field is named by its path, ``linear.x``; an element of a list by its place, ``data.0``. A field that holds several
numbers stands for them all, in their order. In ``sensor_msgs/JointState`` a place is a joint's name: ``velocity`` are
the velocities of all joints, ``velocity.elbow`` is that of one.

Messages in CDR and protobuf are decoded by the definition that their file carries. Such a definition can ask for any
amount of time and memory, so ``sources`` has these files read in a process apart.
"""

from __future__ import annotations

import itertools
import json
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Bool

from dmotion_bench.actions import MOST_NUMBERS
from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture, guarded, ros_decoder, well_known
from dmotion_bench.storage.imports.commands import (
    EmptyCommand,
    fields_given,
    first_needed,
    is_protobuf,
    protobuf_decoder,
)
from dmotion_bench.storage.imports.continuous_commands import (
    EXACT,
    ContinuousCommands,
    meant,
    name_fault,
    value_fault,
)
from dmotion_bench.storage.imports.mcap_records import TopicInfo
from dmotion_bench.storage.imports.ros1_messages import way_out
from dmotion_bench.wording import shown

LISTED: Final = 30  # fields that an error names
JOINTS: Final = "sensor_msgs/JointState"
_DEEPEST: Final = 32  # levels of a message
_MISSING: Final = object()


class _Places(Sequence[str]):
    """The names of a list's elements, made only as they are needed."""

    def __init__(self, places: range) -> None:
        self._places = places

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        return str(self._places[index])

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name.isdecimal() and len(name) < 20 and int(name) in self._places


class ContinuousReader:
    """A ``CommandsReader`` of numbers.

    Args:
        fields: That hold the numbers.
        most: Numbers of all commands together.
    """

    def __init__(self, fields: Sequence[str], most: int) -> None:
        self._fields, self._most = tuple(fields), most
        self._times, self._values = array("q"), array("d")
        self._places = array("q")  # of the messages that hold commands, among all
        self._names: tuple[str, ...] = ()
        self._messages, self._are_joints = 0, False
        self._others: dict[str, bool] = {}  # what the messages that hold none of the joints hold instead

    @property
    def count(self) -> int:
        """Of the messages so far."""
        return self._messages

    @property
    def others(self) -> int:
        """Messages on the topic that hold none of the joints, and do not count: those of another part of the robot."""
        return self._messages - len(self._times)

    def decoder(self, topic: TopicInfo) -> Callable[[bytes], list[float] | None]:
        """What turns the topic's messages into numbers; it raises ``BadPicture`` for a bad message.

        It gives None for a message of joints none of which is wanted.

        Raises:
            RecordingImportError: The messages are written in a way that is not known.
        """
        decode = _message_decoder(topic)
        self._are_joints = well_known(topic) == JOINTS
        may_lack = self._are_joints and all("." in field for field in self._fields)

        def numbers(data: bytes) -> list[float] | None:
            message = decode(data)
            if may_lack and all(_inside(message, field) is _MISSING for field in self._fields):
                if not self._times and len(self._others) < MOST_NUMBERS:
                    self._others |= _paths(message)
                return None
            return self._numbers(message)

        return numbers

    def add(self, t_ns: int, command: Sequence[float] | None) -> None:
        """Take a decoded command.

        Raises:
            RecordingImportError: There are too many.
        """
        self._messages += 1
        if command is None:
            return
        if len(self._values) + len(command) > self._most:
            raise RecordingImportError(
                f"the actions of a recording hold more than the {self._most:,} numbers that can be imported at once; "
                "name fewer fields with '--action-fields', or cut the recording."
            )
        self._places.append(self._messages - 1)
        self._times.append(t_ns)
        self._values.extend(command)

    def collected(self, last_ns: int) -> ContinuousCommands:
        """All commands so far, in the order of their times; see ``CommandsReader``.

        Raises:
            EmptyCommand: Numbers are not finite where a command is needed.
            BadPicture: No message holds a joint that is wanted.
        """
        if self._messages and not self._times:
            raise _unknown(self._others, self._fields[0])
        times = np.array(self._times, np.int64)
        values = np.array(self._values, np.float64).reshape(len(times), -1)
        is_whole: Bool[np.ndarray, " n"] = np.all(np.isfinite(values), axis=1)
        if (place := first_needed(times, is_whole, last_ns)) is not None:
            fault = value_fault(self._names, values[place : place + 1], "in row") or ""
            raise EmptyCommand(
                self._places[place],
                f"holds {fault.replace(' in row 0', '')}; cut the recording before it, or leave '--actions' out",
            )
        order = np.argsort(times, kind="stable")
        kept = order[is_whole[order]]
        return ContinuousCommands(times_ns=times[kept], values=values[kept], names=self._names)

    def _numbers(self, message: Any) -> list[float]:
        """A message's numbers, in the order of the first message's."""
        found = [leaf for field in self._fields for leaf in _chosen(message, field)]
        names = tuple(name for name, _ in found)
        if not self._names:
            if fault := name_fault(names):
                raise BadPicture(f"holds {fault}")
            self._names = names
        if names != self._names:
            return self._reordered(dict(found), len(found))
        return [_number(name, value) for name, value in found]

    def _reordered(self, found: dict[str, Any], count: int) -> list[float]:
        lacking = [name for name in self._names if name not in found]
        more = [name for name in found if name not in self._names]
        if lacking or more or count != len(self._names):
            odd, how = (lacking, "lacks") if lacking else (more or self._names, "has beside the others")
            joints = ", or the joints of one publisher on the topic" if self._are_joints else ""
            raise BadPicture(
                f"{how} the numbers {', '.join(map(shown, odd[:LISTED]))}, other than the first message; name the "
                f"fields that all messages have in '--action-fields'{joints}"
            )
        return [_number(name, found[name]) for name in self._names]


def _number(name: str, value: Any) -> float:
    if not isinstance(value, int | float):  # a truth value is 0 or 1
        raise BadPicture(f"holds {shown(value)} in {shown(name)}, which is no number; name other fields")
    if isinstance(value, int) and abs(value) > EXACT:
        raise BadPicture(f"holds {shown(value)} in {shown(name)}, too large to be kept exactly; name other fields")
    return float(value)


def _chosen(message: Any, field: str) -> list[tuple[str, Any]]:
    """What stands in a field: one number, or those that it is made of."""
    node = _inside(message, field)
    if node is _MISSING:
        raise _unknown(_paths(message), field)
    leaves = ((path, leaf) for path, leaf, is_leaf in _nodes(node, field, 0) if is_leaf)
    found = list(itertools.islice(leaves, MOST_NUMBERS + 1))
    if len(found) > MOST_NUMBERS:
        raise BadPicture(f"holds more than {MOST_NUMBERS} numbers in {shown(field)}; name those that count, one by one")
    if not found:
        raise BadPicture(f"holds nothing in {shown(field)}; name a field with numbers")
    return found


def _paths(message: Any) -> dict[str, bool]:
    """What a message's fields are called, those with parts among them, each with whether it has no parts."""
    nodes = itertools.islice(_nodes(message, "", 0), 2 * MOST_NUMBERS)
    return {path: is_leaf for path, _, is_leaf in nodes if path}


def _unknown(known: Mapping[str, bool], field: str) -> BadPicture:
    """The error for a field that is not among those of a message; see ``_paths``."""
    leaves = [path for path, is_leaf in known.items() if is_leaf]
    listed = ", ".join(map(_plain, leaves[:LISTED])) or "none"
    more = f" ... and more, {len(leaves)} in all" if len(leaves) > LISTED else ""
    return BadPicture(f"has no field {shown(field)}; {meant(list(known), field)} fields are: {listed}{more}")


def _inside(node: Any, path: str) -> Any:
    """What stands at a path; names may hold dots themselves, so the longest that fits is taken first."""
    if not path:
        return node
    children = _children(node)
    for end in [len(path), *(place for place in range(len(path) - 1, 0, -1) if path[place] == ".")]:
        child = _child(node, children, path[:end])
        if child is not _MISSING:
            found = _inside(child, path[end + 1 :])
            if found is not _MISSING:
                return found
    return _MISSING


def _nodes(node: Any, path: str, depth: int) -> Iterator[tuple[str, Any, bool]]:
    """A node and everything in it, by its path, in order, each with whether it has no parts."""
    if depth > _DEEPEST:
        raise BadPicture(f"has more than {_DEEPEST} levels")
    children = _children(node)
    yield path, node, children is None
    for name in children or ():
        child = _child(node, children, name)
        yield from _nodes(child, f"{path}.{name}" if path else name, depth + 1)


def _children(node: Any) -> Sequence[str] | None:
    """The names of a node's parts; None for a node without any."""
    if isinstance(node, Mapping):
        return [name for name in node if isinstance(name, str)]
    if isinstance(node, str | bytes | bytearray | memoryview):
        return None
    if isinstance(node, Sequence):
        return _Places(range(len(node)))
    if is_protobuf(node):
        return fields_given(node)
    slots = getattr(type(node), "__slots__", None)  # ROS
    return list(slots) if isinstance(slots, list) else None


def _child(node: Any, children: Sequence[str] | None, name: str) -> Any:
    if children is None or name not in children:
        return _MISSING
    if isinstance(node, Mapping):
        return node[name]
    return node[int(name)] if isinstance(node, Sequence) else getattr(node, name, _MISSING)


def _joints(message: Any) -> dict[str, Any]:
    """A JointState whose numbers stand under the joints' names."""
    names = _inside(message, "name")
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise BadPicture("names no joints")
    named: dict[str, Any] = {}
    for kind in ("position", "velocity", "effort"):
        values = _inside(message, kind)
        if isinstance(values, Sequence) and len(values) == len(names):
            named[kind] = dict(zip(names, values, strict=True))
            if len(named[kind]) < len(names):
                raise BadPicture("names a joint twice")
        elif values is not _MISSING and len(values):
            raise BadPicture(f"has {len(values)} numbers in {kind!r} for {len(names)} joints")
    return named


def _message_decoder(topic: TopicInfo) -> Callable[[bytes], Any]:
    """What turns a topic's messages into objects with their fields."""
    name = well_known(topic)
    if topic.message_encoding == "json":
        decode = guarded(json.loads, name or "JSON")
    elif topic.message_encoding == "protobuf":
        decode = guarded(protobuf_decoder(topic), name)
    elif topic.message_encoding == "cdr" and topic.schema_encoding == "ros2msg":
        try:
            decode = guarded(ros_decoder(topic.schema_name, topic.schema.decode()), name)
        except Exception as error:  # the parser's own errors have no common kind
            raise RecordingImportError(
                f"{topic.topic!r} carries messages whose definition cannot be used: {str(error)[:120]}."
            ) from error
    else:
        raise RecordingImportError(
            f"{topic.topic!r} carries {topic.schema_name or 'messages without a schema'} written as "
            f"{topic.message_encoding[:40]!r} and defined in {topic.schema_encoding[:40]!r}; the fields are known of "
            "ROS 2 messages defined in 'ros2msg', of protobuf and of JSON. To import the video alone, leave "
            f"'--actions' and '--action-fields' out.{way_out(topic)}"
        )
    if name == JOINTS:
        return lambda data: _joints(decode(data))
    return decode


def _plain(name: str) -> str:
    return name if name.isprintable() and len(name) <= 100 else shown(name)
