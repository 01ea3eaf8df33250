"""An MCAP file of another system as a recording: one camera topic, perhaps one topic of actions."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture, Picture, picture_decoder
from dmotion_bench.storage.imports.commands import Commands, CommandsReader, DiscreteReader, EmptyCommand
from dmotion_bench.storage.imports.continuous_messages import ContinuousReader
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.mcap_records import LATEST, McapFile, RawMessage, TopicInfo
from dmotion_bench.storage.imports.mcap_topics import camera_topic, is_stream, named_topic
from dmotion_bench.storage.imports.pixels import size_of, to_rgb
from dmotion_bench.storage.imports.recording import Clock, Segment, Survey, told_of_harm
from dmotion_bench.storage.imports.two_clocks import (
    Jump,
    apart_s,
    delay_ns,
    is_ascending,
    is_steadier,
    jumps,
    told_of_jumps,
)
from dmotion_bench.wording import duration, shown

MOST_SENDERS = 4  # that are told of
OTHERS = "import the others with '--salvage'"  # of a damaged picture that is not the first
Decoded = TypeVar("Decoded")
Size = tuple[int, int]


class McapRecording:
    """One MCAP file whose camera sends pictures, each in a message; ``mcap_video`` reads those that send a video.

    Args:
        path: The file.
        camera: Its camera topic; None for the only one there is.
        actions: Its topic of actions; None for none.
        action_fields: The fields of the actions that hold their numbers; none for discrete actions.
        clock: Which time counts.
        limits: What the file may make us do.
        salvage: Take what stands before the damage in a damaged file, and for a damaged picture the one before it.

    Raises:
        RecordingImportError: No MCAP file, or it lacks the topics.
    """

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None,
        actions: str | None,
        action_fields: Sequence[str] = (),
        clock: Clock = Clock.LOG,
        limits: ImportLimits,
        salvage: bool = False,
    ) -> None:
        self.path, self._clock, self._limits, self._salvage = path, clock, limits, salvage
        self.unreadable, self._fields = 0, tuple(action_fields)
        self._places: Int64[np.ndarray, " n"] | None = None  # of the messages in time, where the file has another order
        self._told_of_order: list[str] = []
        self._size: Size | None = None  # of the last picture whose head could be read
        self._file = McapFile(path, limits=limits, salvage=salvage)
        topics = self._file.topics()
        self._camera = camera_topic(self._file, topics, camera)
        for topic in topics:
            if topic.topic == self._camera:
                picture_decoder(topic)  # an encoding that is not known is said before anything is read
        self._actions = None if actions is None else named_topic(self._file, topics, actions, "actions")
        if self._actions == self._camera:
            raise RecordingImportError(f"{self._camera!r} is the camera; name the topic of the actions.")

    @property
    def is_stream(self) -> bool:
        """Whether the camera sends a video, so that ``mcap_video`` has to read it."""
        return is_stream(self._file, self._camera)

    def sha256(self) -> str:
        """Of the whole file."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Read every message once: times, sizes, actions.

        Raises:
            RecordingImportError: As the file deserves it.
        """
        times, others, visible, lengths = array("q"), array("q"), array("q"), array("q")
        commands = self._commands_reader()
        decoders: dict[TopicInfo, Callable[[bytes], Any]] = {}
        size: Size | None = None
        senders: dict[str, None] = {}

        def look(found: Iterable[tuple[int, Size]]) -> None:
            nonlocal size
            for number, one in found:
                size = self._same_size(one, size, number)
                visible.append(number)

        for message in self._file.messages(self._camera, self._actions or self._camera):
            if message.topic.topic == self._camera:
                picture = self._decode(message, len(times), decoders, picture_decoder)
                times.append(self._time(picture, message, len(times)))
                if len(senders) < MOST_SENDERS:
                    senders[picture.frame_id] = None
                lengths.append(len(message.data))
                others.append(message.log_ns if self._clock is Clock.HEADER else min(picture.stamp_ns, LATEST))
                look(self._look(picture, len(times) - 1))
                progress(len(visible))
            elif commands is not None:
                commands.add(message.log_ns, self._decode(message, commands.count, decoders, commands.decoder))
        look(self._look_on())
        if not times:
            where = " that stands whole before the damage" if self._file.is_harmed else ""
            raise RecordingImportError(
                f"{str(self.path)!r} has no pictures: there is no message on {self._camera!r}{where}."
            )
        if size is None:
            raise RecordingImportError(
                f"{str(self.path)!r}: no message on {self._camera!r} gives a picture. A video is decoded from a key "
                "frame on that has the headers with it (of H.264 and H.265 the parameter sets, all after start codes): "
                "have the encoder repeat them before each key frame."
            )
        if commands is not None and not commands.count:
            raise RecordingImportError(f"{str(self.path)!r} has no actions: no message is on {self._actions!r}.")
        numbers = np.array(visible)
        taken, logged = (np.array(clock, np.int64)[numbers] for clock in (times, others))
        taken, logged = self._in_order(taken, logged, numbers, np.array(lengths))
        self._check_order(taken, numbers, self._camera)
        given = None if commands is None else self._collected(commands, int(taken[-1]))
        if given is not None:
            self._check_clocks(taken, logged)
        jumped = jumps(taken, logged) if self._clock is Clock.LOG else []
        harm = [told_of_harm(self.path, taken)] if self._file.is_harmed else []
        hints = self._clock_hints(taken, logged, jumped)
        return Survey(
            camera=self._camera,
            height=size[0],
            width=size[1],
            segments=[Segment(times_ns=taken, commands=given, jumps=[jump.picture for jump in jumped])],
            hints=hints,
            told=[
                *harm,
                *([f"{told_of_jumps(self.path, jumped)}."] if jumped else []),
                *self._several(senders),
                *self._told_of_order,
                *self._told_of_video(taken, logged),
                *self._other_messages(commands),
            ],
            delay_ns=0 if hints or self._clock is Clock.HEADER else delay_ns(taken, logged),
        )

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Unpack the wanted frames and no others; where damage is to be lived with, a damaged one repeats the last."""
        decoders: dict[TopicInfo, Callable[[bytes], Any]] = {}
        whole: UInt8[np.ndarray, "h w 3"] | None = None
        numbers = iter(wanted.tolist())
        number = next(numbers, None)
        for count, message in self._camera_messages():
            if number is None:
                return
            if count != number:
                continue
            picture = self._decode(message, count, decoders, picture_decoder)
            try:
                whole = to_rgb(picture, self._limits)
            except BadPicture as error:
                if not self._salvage:
                    way_out = f"; {OTHERS}" if whole is not None else ""
                    raise self._bad(count, self._camera, f"{error}{way_out}") from error
                if whole is None:
                    raise self._bad(count, self._camera, f"{error}, and no whole picture comes before it") from error
                self.unreadable += 1
            yield whole
            number = next(numbers, None)
        if number is not None:
            raise self._changed()

    def _look(self, picture: Picture, number: int) -> Iterator[tuple[int, Size]]:
        """The numbers and sizes of the pictures that can be shown now that a message is there."""
        try:
            self._size = size_of(picture, self._limits)
        except BadPicture as error:
            if not self._salvage and self._size is not None:
                raise self._bad(number, self._camera, f"{error}; {OTHERS}") from error
            if self._size is None:
                raise self._bad(number, self._camera, error) from error
        yield number, self._size

    def _look_on(self) -> Iterator[tuple[int, Size]]:
        """The same of those that still wait at the end of the file."""
        yield from ()

    def _commands_reader(self) -> CommandsReader | None:
        if self._actions is None:
            return None
        return ContinuousReader(self._fields, self._limits.numbers) if self._fields else DiscreteReader()

    def _collected(self, commands: CommandsReader, last_ns: int) -> Commands:
        try:
            return commands.collected(last_ns)
        except BadPicture as error:
            number = error.number if isinstance(error, EmptyCommand) else 0
            raise self._bad(number, self._actions or "", error) from error

    def _other_messages(self, commands: CommandsReader | None) -> list[str]:
        """What is told of messages that other parts of the robot send on the topic of the actions."""
        if commands is None or not commands.others:
            return []
        joints = ", ".join(self._fields)
        return [f"{commands.others:,} messages on {self._actions!r} hold none of the joints {joints} and do not count."]

    def _several(self, senders: Iterable[str]) -> list[str]:
        """What is told of a topic on which several cameras may send, as two robots do without namespaces."""
        named = [shown(one) for one in senders if one]
        if len(named) < 2:
            return []
        return [
            f"the pictures on {self._camera!r} have several values of 'frame_id' ({', '.join(named)}): if several "
            "cameras send there, their pictures alternate in the episodes. Record each on a topic of its own."
        ]

    def _told_of_video(self, times_ns: Int64[np.ndarray, " n"], others_ns: Int64[np.ndarray, " n"]) -> list[str]:
        """What is told of pictures that depend on each other, by the clock that counts and the other one."""
        return []

    def _camera_messages(self) -> Iterator[tuple[int, RawMessage]]:
        """The camera's messages in the order of their times, each with its place; some may wait for earlier ones."""
        messages = self._file.messages(self._camera)
        if self._places is None:
            yield from enumerate(messages)
            return
        waiting: dict[int, RawMessage] = {}
        due = 0
        for place, message in zip(self._places.tolist(), messages, strict=False):
            waiting[place] = message
            while due in waiting:
                yield due, waiting.pop(due)
                due += 1

    def _in_order(
        self,
        times_ns: Int64[np.ndarray, " n"],
        others_ns: Int64[np.ndarray, " n"],
        numbers: Int64[np.ndarray, " n"],
        lengths: Int64[np.ndarray, " m"],
    ) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Both clocks in the order of the recorder's, as all readers of MCAP give messages in the order of their times.

        They stay as they are where too many bytes of messages would have to wait for earlier ones.

        Args:
            times_ns, others_ns: Of each picture, in the order in which the file gives them.
            numbers: Of the message that holds it.
            lengths: Of all messages [bytes].

        Raises:
            RecordingImportError: The clock was set back: in its order, pictures of two moments would alternate.
        """
        self._places, self._told_of_order = None, []
        intervals = np.diff(times_ns)
        if self._clock is not Clock.LOG or not (intervals < 0).any():
            return times_ns, others_ns
        furthest = int(intervals.argmin())
        if is_ascending(others_ns) and -intervals[furthest] > np.median(intervals):
            raise self._set_back(furthest, -int(intervals[furthest]))
        order = np.argsort(times_ns, kind="stable")
        last_before = np.maximum.accumulate(order)  # what has to be read before a message, in time, can be given
        given = np.searchsorted(last_before, np.arange(len(order)), side="right")
        waiting = np.cumsum(lengths) - np.append(0, np.cumsum(lengths[order]))[given]
        if waiting.max() > self._limits.message_bytes:
            return times_ns, others_ns
        self._places = np.argsort(order)
        self._told_of_order = [
            f"{np.count_nonzero(intervals < 0):,} of {len(order):,} messages on {self._camera!r} were written after a "
            f"later one, by up to {duration(-intervals[furthest] / 1e9)}, and are sorted by the times of recording. If "
            "the clock was set back while they were recorded, pictures of two moments alternate there: cut the file."
        ]
        return times_ns[order], others_ns[order]

    def _set_back(self, number: int, back_ns: int) -> RecordingImportError:
        """The error for a clock that goes back while the pictures' own time stamps go on."""
        way_out = "use '--clock header'"
        if self._actions is not None:
            way_out = "its actions cannot be told from others: leave '--actions' out and use '--clock header'"
        return RecordingImportError(
            f"{str(self.path)!r}: the times of recording on {self._camera!r} go back by {back_ns / 1e9:.3f} s at "
            f"message {number + 1}, and the camera's own time stamps go on, so the recorder's clock was set back; "
            f"{way_out}."
        )

    def _decode(
        self,
        message: RawMessage,
        count: int,
        decoders: dict[TopicInfo, Callable[[bytes], Any]],
        make: Callable[[TopicInfo], Callable[[bytes], Decoded]],
    ) -> Decoded:
        decoder = decoders.get(message.topic)
        if decoder is None:
            decoder = decoders[message.topic] = make(message.topic)
        try:
            decoded: Decoded = decoder(message.data)
        except BadPicture as error:
            raise self._bad(count, message.topic.topic, error) from error
        return decoded

    def _same_size(self, size: Size, before: Size | None, count: int) -> Size:
        if before is not None and size != before:
            raise RecordingImportError(
                f"{str(self.path)!r} mixes picture sizes on {self._camera!r}: {before[1]}x{before[0]} pixels at first, "
                f"{size[1]}x{size[0]} in message {count}. Split the file where the camera was changed, "
                "and import the parts on their own."
            )
        return size

    def _time(self, picture: Picture, message: RawMessage, count: int) -> int:
        if self._clock is Clock.LOG:
            return message.log_ns
        if not picture.stamp_ns and count:  # a simulator's clock may begin at 0
            raise RecordingImportError(
                f"{str(self.path)!r}: message {count} on {self._camera!r} has no time stamp of its own; "
                "use the time of recording with '--clock log'."
            )
        if picture.stamp_ns > LATEST:
            raise self._bad(
                count,
                self._camera,
                f"has a time stamp {duration(picture.stamp_ns / 1e9)} after 1970, which no clock shows; use "
                "'--clock log'",
            )
        return picture.stamp_ns

    def _check_order(self, times_ns: Int64[np.ndarray, " n"], numbers: Int64[np.ndarray, " n"], topic: str) -> None:
        """Compare the times of what follows one another; ``numbers`` are those of the messages."""
        back = np.flatnonzero(np.diff(times_ns) < 0)
        if len(back):
            later = int(back[0]) + 1
            raise RecordingImportError(
                f"{str(self.path)!r}: on {topic!r} time goes backwards by "
                f"{(times_ns[later - 1] - times_ns[later]) / 1e9:.3f} s at message {numbers[later]}; try the other "
                "clock ('--clock log' or '--clock header'), or put the messages in order with "
                "'mcap sort FILE -o SORTED'."
            )

    def _check_clocks(self, times_ns: Int64[np.ndarray, " n"], others_ns: Int64[np.ndarray, " n"]) -> None:
        """Actions have the time at which they were recorded: the camera's clock has to agree with it."""
        if self._clock is Clock.LOG or (apart := apart_s(others_ns, times_ns)) is None:
            return
        if found := jumps(others_ns, times_ns):
            raise RecordingImportError(
                f"{told_of_jumps(self.path, found)}, so these are of another clock than the actions; use '--clock log'."
            )
        raise RecordingImportError(
            f"{str(self.path)!r}: the time stamps of {self._camera!r} are {duration(abs(apart))} "
            f"{'before' if apart > 0 else 'after'} the times of recording, so they are of another clock than the "
            "actions; use '--clock log'."
        )

    def _clock_hints(
        self, times_ns: Int64[np.ndarray, " n"], others_ns: Int64[np.ndarray, " n"], jumped: Sequence[Jump]
    ) -> list[str]:
        """Whether the clock that was not asked for is the steadier one."""
        if jumped:
            hint = "an episode ends where the recorder's clock jumped; '--clock header' does not cut there"
            if self._actions is not None:
                hint += ", but cannot be used with '--actions': the actions have the recorder's times"
            return [f"{hint}."]
        if not is_ascending(others_ns) or not is_steadier(times_ns, others_ns):
            return []
        if self._clock is Clock.HEADER:
            return [
                f"the time stamps of {self._camera!r} are uneven, its times of logging are steadier: use '--clock log'."
            ]
        hint = f"{self._camera!r} was logged in bursts, its own time stamps are steadier"
        if self._actions is None or apart_s(times_ns, others_ns) is None:
            return [f"{hint}: use '--clock header'."]
        return [
            f"{hint}, but of another clock than the actions: '--clock header' can be used without '--actions' alone."
        ]

    def _bad(self, count: int, topic: str, error: object) -> RecordingImportError:
        return RecordingImportError(f"{str(self.path)!r}: message {count} on {topic!r} {error}.")

    def _changed(self) -> RecordingImportError:
        return RecordingImportError(f"{str(self.path)!r} changed while it was imported; import it again.")
