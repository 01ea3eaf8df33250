"""Episodes to messages and back: pictures, actions, states, factors.

Frame i of an episode is stamped ``start_ns + i * step_ns``; the action taken at it bears the same stamp.

Protobuf's fields may follow one another in pieces. The messages of an episode differ in few of them, so the rest is
serialised once, and the stamp, field 1 of every message here, is put before it.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.actions import ActionSpec, Continuous, require_discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.specs import EnvSpec, EpisodeLabels, ObjectSpec, ObjectStates, Scalar
from dmotion_bench.storage.json_file import JsonUnreadable, parse_json
from dmotion_bench.storage.mcap_reader import DamagedFile, MessageView
from dmotion_bench.storage.mcap_writer import CHUNK_LIMIT, Message
from dmotion_bench.storage.schema import (
    ACTION,
    ACTION_TOPIC,
    AGENT_TOPIC,
    CONTINUOUS_ACTION,
    FACTORS,
    FACTORS_TOPIC,
    LABEL_CHANNELS,
    MASKS_TOPIC,
    OBJECTS_TOPIC,
    RAW_IMAGE,
    STATES,
)
from dmotion_bench.wording import shown
from dmotion_bench.workspace import DATASET_MANIFEST

_CAMERA: Final = 1
_CAMERA_FRAME: Final = "camera"
_STAMP_FIELD: Final = 0x0A  # field 1, a message: what every message here begins with
_LABEL_NUMBER: Final = {topic: number for number, (topic, _) in enumerate(LABEL_CHANNELS, start=1)}
_STATE_NUMBERS: Final = 3 + 4 + 2 + 1  # position, orientation, pixel, visible
_MESSAGE_OVERHEAD: Final = 4096  # more than a picture's other fields, or an action, can take
_STATE_OVERHEAD: Final = 256  # more than a state can take without its name
_FACTORS_LARGEST: Final = 2**20  # [bytes]


def chunk_limit(spec: EnvSpec) -> int:
    """Largest uncompressed chunk that a data set of this kind can hold [bytes]."""
    return CHUNK_LIMIT + spec.height * spec.width * 3 + _largest_states((*spec.agents, *spec.objects))


def _largest_states(things: Sequence[ObjectSpec]) -> int:
    """More than the message of the states of some things can take [bytes]."""
    return _MESSAGE_OVERHEAD + sum(len(one.name.encode()) + _STATE_OVERHEAD for one in things)


def _stamp(t_ns: int) -> bytes:
    message = STATES.new()
    message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, 1_000_000_000)
    return _serialized(message)


def _serialized(message: Any) -> bytes:
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def _encode_images(
    images: UInt8[np.ndarray, "t h w *c"], channel: int, encoding: str, frame_id: str, start_ns: int, step_ns: int
) -> Iterator[Message]:
    rows = np.ascontiguousarray(images).reshape(len(images), -1)
    head, tail = _around_pixels(images.shape[1:], encoding, frame_id)
    for number, row in enumerate(rows):
        t_ns = start_ns + number * step_ns
        yield Message(channel, t_ns, (_stamp(t_ns), head, row.data, tail))


@cache
def _around_pixels(shape: tuple[int, ...], encoding: str, frame_id: str) -> tuple[bytes, bytes]:
    """What stands before and after the pixels of a picture of this shape, as it is written here, but the stamp."""
    height, width, size = *shape[:2], math.prod(shape)
    head = _serialized(RAW_IMAGE.new(width=width, height=height, encoding=encoding, step=size // height))
    head += _serialized(RAW_IMAGE.new(data=bytes(size)))[:-size]
    return head, _serialized(RAW_IMAGE.new(frame_id=frame_id))


def _decode_images(
    messages: Iterable[MessageView], channel: int, encoding: str, out: UInt8[np.ndarray, "t h w *c"]
) -> None:
    height, width = out.shape[1:3]
    count, size = 0, math.prod(out.shape[1:])
    head, tail = _around_pixels(out.shape[1:], encoding, _CAMERA_FRAME)
    rows = out.reshape(len(out), -1)
    for view in messages:
        # as it is written here, without a copy by protobuf, which takes as long as the unpacking: stamp, head, pixels
        pixels = len(view.data) - len(tail) - size
        if (
            pixels > len(head)
            and count < len(out)
            and view.channel == channel
            and view.data[0] == _STAMP_FIELD
            and view.data[1] + 2 + len(head) == pixels
            and view.data[pixels - len(head) : pixels] == head
            and view.data[pixels + size :] == tail
        ):
            rows[count] = np.frombuffer(view.data, np.uint8, size, pixels)
            count += 1
            continue
        message = _parse(RAW_IMAGE.new(), view, channel, size + _MESSAGE_OVERHEAD)
        if (message.width, message.height, message.encoding) != (width, height, encoding):
            raise DamagedFile(
                f"holds a picture of {message.width}x{message.height} {shown(message.encoding)}; "
                f"the data set says {width}x{height} {encoding!r}"
            )
        if count == len(out) or len(message.data) != size:
            raise DamagedFile("holds other pictures than the data set says")
        out[count] = np.frombuffer(message.data, np.uint8).reshape(out.shape[1:])
        count += 1
    if count < len(out):
        raise DamagedFile(f"holds {count} pictures of an episode that has {len(out)}")


def _parse(message: Any, view: MessageView, channel: int, largest: int) -> Any:
    """The message's content; protobuf may need a hundred times the memory of what it parses."""
    if view.channel != channel:
        raise DamagedFile(f"holds a message of channel {view.channel} where channel {channel} was expected")
    if len(view.data) > largest:
        raise DamagedFile(f"holds a message of {len(view.data):,} bytes; at most {largest:,} can be right")
    try:
        message.ParseFromString(bytes(view.data))
    except DecodeError as error:
        raise DamagedFile(f"holds a message that is no {message.DESCRIPTOR.full_name}: {error}") from None
    return message


def encode_video(frames: UInt8[np.ndarray, "t h w 3"], start_ns: int, step_ns: int) -> Iterator[Message]:
    """The messages of ``/camera``."""
    return _encode_images(frames, _CAMERA, "rgb8", _CAMERA_FRAME, start_ns, step_ns)


def decode_video(messages: Iterable[MessageView], out: UInt8[np.ndarray, "t h w 3"]) -> None:
    """Fill ``out`` with the pictures of ``/camera``."""
    _decode_images(messages, _CAMERA, "rgb8", out)


def encode_masks(masks: UInt8[np.ndarray, "t h w"], start_ns: int, step_ns: int) -> Iterator[Message]:
    """The messages of ``/masks``."""
    return _encode_images(masks, _LABEL_NUMBER[MASKS_TOPIC], "mono8", _CAMERA_FRAME, start_ns, step_ns)


def decode_masks(messages: Iterable[MessageView], out: UInt8[np.ndarray, "t h w"]) -> None:
    """Fill ``out`` with the pictures of ``/masks``."""
    _decode_images(messages, _LABEL_NUMBER[MASKS_TOPIC], "mono8", out)


def encode_states(labels: EpisodeLabels, spec: EnvSpec, start_ns: int, step_ns: int) -> Iterator[Message]:
    """The messages of ``/factors``, ``/action``, ``/agent`` and ``/objects``, in the order of their times.

    Raises:
        InvalidSetting: An action is none that the environment has, or its factors could not be read again.
    """
    acts = _acts(labels, spec)
    if labels.factors:
        content = json.dumps(dict(labels.factors), sort_keys=True)
        try:
            parse_json(content, largest=_FACTORS_LARGEST - _MESSAGE_OVERHEAD)
        except JsonUnreadable as error:
            raise _impossible(spec, f"factors of which no reader takes any: {error}") from None
        yield Message(
            _LABEL_NUMBER[FACTORS_TOPIC], start_ns, (_stamp(start_ns), _serialized(FACTORS.new(json=content)))
        )
    agent = _states_encoder(tuple(one.name for one in spec.agents)).encode(labels.agent)
    objects = _states_encoder(tuple(one.name for one in spec.objects)).encode(labels.objects)
    for frame, (agent_states, object_states) in enumerate(zip(agent, objects, strict=True)):
        t_ns = start_ns + frame * step_ns
        stamp = _stamp(t_ns)
        if frame < len(labels.actions):
            yield Message(_LABEL_NUMBER[ACTION_TOPIC], t_ns, (stamp, acts[frame]))
        yield Message(_LABEL_NUMBER[AGENT_TOPIC], t_ns, (stamp, agent_states))
        yield Message(_LABEL_NUMBER[OBJECTS_TOPIC], t_ns, (stamp, object_states))


def _acts(labels: EpisodeLabels, spec: EnvSpec) -> list[bytes]:
    """What follows the stamp in the message of each action."""
    pushed = labels.pushed.tolist()
    if spec.actions is not None and (fault := spec.actions.fault(labels.actions)):
        raise _impossible(spec, fault)
    if isinstance(spec.actions, Continuous):
        values = np.asarray(labels.actions, np.float64).tolist()
        return [
            _serialized(CONTINUOUS_ACTION.new(values=one, pushed=moved))
            for one, moved in zip(values, pushed, strict=True)
        ]
    numbers = labels.actions.tolist()
    names = require_discrete(spec.actions, "a label").names if numbers else ()
    known = {
        (number, moved): _serialized(ACTION.new(action=number, name=names[number], pushed=moved))
        for number, moved in set(zip(numbers, pushed, strict=True))
    }
    return [known[act] for act in zip(numbers, pushed, strict=True)]


def _impossible(spec: EnvSpec, what: str) -> InvalidSetting:
    """The error for an episode that could be written and not read."""
    return InvalidSetting(
        f"an episode of {shown(spec.id)} holds {what}; mend the environment or recording that it comes from."
    )


class _StatesEncoder:
    """Encodes the states of a whole episode at once, ten times faster than message by message.

    Every number is a double of eight bytes, so the messages of an episode differ in known places only: they are
    copies of a pattern, made once by protobuf itself with a mark in each place. (A zero is then written out where
    protobuf would leave it away; every reader takes both.)
    """

    def __init__(self, names: Sequence[str]) -> None:
        marks = [1e300 + 1e290 * place for place in range(len(names) * _STATE_NUMBERS)]
        message, mark = STATES.new(), iter(marks)
        for name in names:
            state = message.states.add(name=name)
            position, orientation, pixel = state.pose.position, state.pose.orientation, state.pixel
            position.x, position.y, position.z = next(mark), next(mark), next(mark)
            orientation.x, orientation.y, orientation.z, orientation.w = (next(mark) for _ in range(4))
            pixel.x, pixel.y, state.visible = next(mark), next(mark), next(mark)
        pattern: bytes = message.SerializeToString(deterministic=True)
        offsets = [pattern.index(struct.pack("<d", one)) for one in marks]
        self._pattern = np.frombuffer(pattern, np.uint8)
        self._places = np.array(offsets, np.int64).reshape(-1, 1) + np.arange(8)

    def encode(self, states: ObjectStates) -> list[bytes]:
        """The repeated field ``states`` of each frame's message."""
        if not self._places.size:
            return [b""] * len(states.visible)  # imported recordings know no objects
        parts = (states.position, states.orientation, states.pixel, states.visible[..., None])
        numbers = np.concatenate([np.asarray(part, "<f8") for part in parts], axis=-1)
        encoded = np.tile(self._pattern, (len(numbers), 1))
        encoded[:, self._places] = numbers.reshape(len(numbers), -1, 1).view(np.uint8)
        return [row.tobytes() for row in encoded]


@cache
def _states_encoder(names: tuple[str, ...]) -> _StatesEncoder:
    return _StatesEncoder(names)


@dataclass(frozen=True, kw_only=True)
class StateLabels:
    """An episode's labels without its masks."""

    actions: Int[np.ndarray, " s"] | Float[np.ndarray, "s a"]  # s = t - 1 steps
    pushed: Bool[np.ndarray, " s"]
    agent: ObjectStates
    objects: ObjectStates
    factors: Mapping[str, Scalar]


def decode_states(messages: Iterable[MessageView], spec: EnvSpec, frames: int) -> StateLabels:
    """The labels of an episode of so many frames."""
    actions, pushed = _ActionsDecoder(spec.actions, frames), np.empty(max(frames - 1, 0), np.bool_)
    agent, objects = _StatesDecoder(spec.agents, frames), _StatesDecoder(spec.objects, frames)
    factors: dict[str, Scalar] | None = None
    for view in messages:
        topic = LABEL_CHANNELS[view.channel - 1][0] if 1 <= view.channel <= len(LABEL_CHANNELS) else ""
        if topic == ACTION_TOPIC:
            moved = actions.decode(view)
            pushed[actions.count - 1] = moved
        elif topic == AGENT_TOPIC:
            agent.decode(view)
        elif topic == OBJECTS_TOPIC:
            objects.decode(view)
        elif topic == FACTORS_TOPIC:
            if factors is not None:  # a small file could hold a million of them
                raise DamagedFile("holds the factors twice")
            factors = _factors(_parse(FACTORS.new(), view, view.channel, _FACTORS_LARGEST).json)
        else:
            raise DamagedFile(f"holds a message of channel {view.channel} among the states")
    if agent.count != frames or objects.count != frames or actions.count != len(pushed):
        raise DamagedFile(f"holds {agent.count} states and {actions.count} actions of an episode of {frames} frames")
    return StateLabels(
        actions=actions.array(),
        pushed=pushed,
        agent=agent.states(),
        objects=objects.states(),
        factors=factors or {},
    )


class _ActionsDecoder:
    """Takes an episode's actions out of message after message.

    Attributes:
        count: Messages so far.
    """

    def __init__(self, spec: ActionSpec | None, frames: int) -> None:
        self._spec, self._frames, self.count = spec, frames, 0
        kind, shape = (np.dtype(np.int64), ()) if spec is None else (spec.dtype, spec.shape)
        self._table = np.empty((max(frames - 1, 0), *shape), kind)

    def decode(self, view: MessageView) -> bool:
        """Take one message; says whether something was pushed."""
        kind, wanted = ("continuous", CONTINUOUS_ACTION) if isinstance(self._spec, Continuous) else ("discrete", ACTION)
        message = _parse(wanted.new(), view, view.channel, _MESSAGE_OVERHEAD)
        if len(UnknownFieldSet(message)):  # protobuf itself would read another type's message as action 0
            raise DamagedFile(
                f"holds an action at step {self.count} that is no {wanted.name}, the type of {kind} actions, "
                f"and {DATASET_MANIFEST} says that they are {kind}"
            )
        if isinstance(self._spec, Continuous):
            action, known = list(message.values), len(message.values) == self._spec.width
        else:
            action = message.action
            known = self._spec is not None and 0 <= action < len(self._spec)
        if self.count == len(self._table) or not known:
            raise DamagedFile(
                f"holds action {shown(action)} at step {self.count} of an episode of {self._frames} frames"
            )
        self._table[self.count] = action
        self.count += 1
        return bool(message.pushed)

    def array(self) -> Int[np.ndarray, " s"] | Float[np.ndarray, "s a"]:
        """All of them."""
        if self._spec is not None and (fault := self._spec.fault(self._table)):
            raise DamagedFile(f"holds {fault}")
        return self._table


class _StatesDecoder:
    """Takes the states of some things out of message after message, into memory that is set aside once.

    Attributes:
        count: Messages so far.
    """

    def __init__(self, things: Sequence[ObjectSpec], frames: int) -> None:
        self._names, self.count = [one.name for one in things], 0
        self._largest = _largest_states(things)
        self._table = np.empty((frames, len(things), _STATE_NUMBERS), np.float64)

    def decode(self, view: MessageView) -> None:
        """Take one message."""
        message = _parse(STATES.new(), view, view.channel, self._largest)
        if [state.name for state in message.states] != self._names:
            raise DamagedFile(f"holds the states of other things than {shown(self._names)}")
        if self.count == len(self._table):
            raise DamagedFile(f"holds more than the {self.count} states of its episode")
        if self._names:
            self._table[self.count] = [_state_row(state) for state in message.states]
        self.count += 1

    def states(self) -> ObjectStates:
        """All of them."""
        table = self._table
        return ObjectStates(
            position=table[..., :3], orientation=table[..., 3:7], pixel=table[..., 7:9], visible=table[..., 9]
        )


def _state_row(state: Any) -> tuple[float, ...]:
    position, orientation, pixel = state.pose.position, state.pose.orientation, state.pixel
    return (
        *(position.x, position.y, position.z),
        *(orientation.x, orientation.y, orientation.z, orientation.w),
        *(pixel.x, pixel.y),
        state.visible,
    )


def _factors(content: str) -> dict[str, Scalar]:
    try:
        factors = parse_json(content, largest=_FACTORS_LARGEST)
    except JsonUnreadable as error:
        raise DamagedFile(f"holds factors that cannot be read: {error}") from None
    if not all(isinstance(value, str | bool | int | float) for value in factors.values()):
        raise DamagedFile("holds factors that are no plain values")
    return factors
