"""An MCAP file of another system as a recording: one camera topic, perhaps one topic of actions."""

from __future__ import annotations

import difflib
import hashlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture, Picture, is_camera, picture_decoder
from dmotion_bench.storage.imports.commands import Commands, command_decoder
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.mcap_records import LATEST, McapFile, RawMessage, TopicInfo
from dmotion_bench.storage.imports.pixels import size_of, to_rgb
from dmotion_bench.storage.imports.recording import Clock, Segment, Survey
from dmotion_bench.storage.imports.timeline import irregularity

LISTED = 30  # topics that an error names
UNEVEN = 0.5  # of intervals: jitter is less, pauses and bursts are more
Decoded = TypeVar("Decoded")


class McapRecording:
    """One MCAP file.

    Args:
        path: The file.
        camera: Its camera topic; None for the only one there is.
        actions: Its topic of actions; None for none.
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
        clock: Clock = Clock.LOG,
        limits: ImportLimits,
        salvage: bool = False,
    ) -> None:
        self.path, self._clock, self._limits, self._salvage = path, clock, limits, salvage
        self.unreadable = 0
        self._file = McapFile(path, limits=limits, salvage=salvage)
        topics = self._file.topics()
        self._camera = _camera_topic(path, topics, camera)
        for topic in topics:
            if topic.topic == self._camera:
                picture_decoder(topic)  # an encoding that is not known is said before anything is read
        self._actions = None if actions is None else _topic(path, topics, actions, "actions")
        if self._actions == self._camera:
            raise RecordingImportError(f"{self._camera!r} is the camera; name the topic of the actions.")

    def sha256(self) -> str:
        """Of the whole file."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def survey(self) -> Survey:
        """Read every message once: times, sizes, actions.

        Raises:
            RecordingImportError: As the file deserves it.
        """
        times, others, given = array("q"), array("q"), array("q")
        names: list[str] = []
        size: tuple[int, int] | None = None
        decoders: dict[TopicInfo, Callable[[bytes], Any]] = {}
        known: dict[str, str] = {}
        for message in self._file.messages(self._camera, self._actions or self._camera):
            if message.topic.topic == self._camera:
                picture = self._decode(message, len(times), decoders, picture_decoder)
                size = self._same_size(self._check(picture, len(times)), size, len(times))
                _append_in_order(times, self._time(picture, message, len(times)), self.path, self._camera)
                others.append(message.log_ns if self._clock is Clock.HEADER else min(picture.stamp_ns, LATEST))
            else:
                name = self._decode(message, len(given), decoders, command_decoder)
                names.append(known.setdefault(name, name))
                _append_in_order(given, message.log_ns, self.path, message.topic.topic)
        if size is None:
            raise RecordingImportError(f"{str(self.path)!r} has no pictures: there is no message on {self._camera!r}.")
        if self._actions is not None and not names:
            raise RecordingImportError(f"{str(self.path)!r} has no actions: no message is on {self._actions!r}.")
        commands = Commands(times_ns=_times(given), names=names) if self._actions is not None else None
        return Survey(
            camera=self._camera,
            height=size[0],
            width=size[1],
            segments=[Segment(times_ns=_times(times), commands=commands)],
            hints=self._clock_hints(_times(times), _times(others)),
        )

    def _clock_hints(self, times_ns: Int64[np.ndarray, " n"], others_ns: Int64[np.ndarray, " n"]) -> list[str]:
        """Whether the clock that was not asked for is the steadier one."""
        if (np.diff(others_ns) <= 0).any():
            return []
        uneven = irregularity(times_ns)
        if uneven < UNEVEN or uneven < 2 * irregularity(others_ns):
            return []
        if self._clock is Clock.LOG:
            return [f"{self._camera!r} was logged in bursts, its own time stamps are steadier: use '--clock header'."]
        return [
            f"the time stamps of {self._camera!r} are uneven, its times of logging are steadier: use '--clock log'."
        ]

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Unpack the wanted frames and no others; where damage is to be lived with, a damaged one repeats the last."""
        decoders: dict[TopicInfo, Callable[[bytes], Any]] = {}
        shown: UInt8[np.ndarray, "h w 3"] | None = None
        numbers = iter(wanted.tolist())
        number = next(numbers, None)
        if number is None:
            return
        for count, message in enumerate(self._file.messages(self._camera)):
            if count != number:
                continue
            picture = self._decode(message, count, decoders, picture_decoder)
            try:
                shown = to_rgb(picture, self._limits)
            except BadPicture as error:
                if not self._salvage:
                    way_out = "; import the others with '--salvage'" if shown is not None else ""
                    raise self._bad(count, self._camera, f"{error}{way_out}") from error
                if shown is None:
                    raise self._bad(count, self._camera, f"{error}, and no whole picture comes before it") from error
                self.unreadable += 1
            yield shown
            number = next(numbers, None)
            if number is None:
                return
        raise RecordingImportError(f"{str(self.path)!r} changed while it was imported; import it again.")

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

    def _check(self, picture: Picture, count: int) -> tuple[int, int]:
        try:
            return size_of(picture, self._limits)
        except BadPicture as error:
            raise self._bad(count, self._camera, error) from error

    def _same_size(self, size: tuple[int, int], before: tuple[int, int] | None, count: int) -> tuple[int, int]:
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
        if not picture.stamp_ns:
            raise RecordingImportError(
                f"{str(self.path)!r}: message {count} on {self._camera!r} has no time stamp of its own; "
                "use the time of recording with '--clock log'."
            )
        if picture.stamp_ns > LATEST:
            raise self._bad(
                count,
                self._camera,
                f"has a time stamp {picture.stamp_ns / 1e9:.3g} s after 1970, which no clock shows; use '--clock log'",
            )
        return picture.stamp_ns

    def _bad(self, count: int, topic: str, error: object) -> RecordingImportError:
        return RecordingImportError(f"{str(self.path)!r}: message {count} on {topic!r} {error}.")


def _append_in_order(times: array[int], t_ns: int, path: Path, topic: str) -> None:
    if times and t_ns < times[-1]:
        raise RecordingImportError(
            f"{str(path)!r}: on {topic!r} time goes backwards by {(times[-1] - t_ns) / 1e9:.3f} s at message "
            f"{len(times)}; try the other clock ('--clock log' or '--clock header'), or put the messages in order with "
            "'mcap sort FILE -o SORTED'."
        )
    times.append(t_ns)


def _times(times: array[int]) -> Int64[np.ndarray, " n"]:
    return np.array(times, np.int64)


def _camera_topic(path: Path, topics: Sequence[TopicInfo], asked: str | None) -> str:
    cameras = sorted({topic.topic for topic in topics if is_camera(topic)})
    if asked is not None:
        return _topic(path, topics, asked, "camera")
    if len(cameras) == 1:
        return cameras[0]
    if not cameras:
        raise RecordingImportError(
            f"{str(path)!r} has no camera topic that can be imported (foxglove.RawImage, foxglove.CompressedImage, "
            f"sensor_msgs/msg/Image, sensor_msgs/msg/CompressedImage); {_listing(topics)}"
        )
    choices = "\n".join(f"  --camera {topic!r}" for topic in cameras[:LISTED])
    raise RecordingImportError(f"{str(path)!r} has {len(cameras)} camera topics; choose one:\n{choices}")


def _topic(path: Path, topics: Sequence[TopicInfo], asked: str, option: str) -> str:
    names = sorted({topic.topic for topic in topics})
    if asked in names:
        return asked
    near = difflib.get_close_matches(asked, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise RecordingImportError(f"{str(path)!r} has no topic {asked!r} for '--{option}'; {hint}{_listing(topics)}")


def _listing(topics: Sequence[TopicInfo]) -> str:
    if not topics:
        return "it has no topics at all."
    shown = "".join(
        f"\n  {topic.topic!r} {topic.schema_name or topic.message_encoding}{' (camera)' if is_camera(topic) else ''}"
        for topic in sorted(topics, key=lambda topic: (not is_camera(topic), topic.topic))[:LISTED]
    )
    more = f"\n  ... and {len(topics) - LISTED} more" if len(topics) > LISTED else ""
    return f"its topics are:{shown}{more}"
