"""The interface of foreign recordings, whatever their container."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.commands import Commands
from dmotion_bench.wording import counted, duration


class Clock(StrEnum):
    """Which time counts as the time of a frame."""

    LOG = "log"  # when the message was recorded
    HEADER = "header"  # when the camera says that it took the picture


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A stretch of a recording with one time axis.

    Attributes:
        times_ns: When each frame was taken, ascending.
        commands: The actions over the same time; None where none were asked for.
        name: What a recording with several segments calls this one, for sentences; empty where it is the only one.
        number: By which ``Recording.pictures`` knows it; None: its place in the survey.
        jumps: Numbers of frames before which the clock jumped: no frames are missing there.
        source: The number of what this is a part of, which the recording's other parts of it have too; None: nothing.
    """

    times_ns: Int64[np.ndarray, " n"]
    commands: Commands | None = None
    name: str = ""
    number: int | None = None
    jumps: Sequence[int] = ()
    source: int | None = None


@dataclass(frozen=True, kw_only=True)
class Survey:
    """The content of a recording, found without decoding its pictures.

    Attributes:
        camera: The topic or key that the pictures are from.
        height, width: Of every picture [px].
        segments: At least one, each with at least one frame.
        hints: Sentences about a better way to import the recording, for whoever asked for this one. They say why no
            episode comes out of it, if none does.
        told: Sentences about what is in the recording.
        is_deep: Whether the pictures are files in grey with 16 bits a pixel, as depth is stored.
        skipped: Segments that were left out because they are damaged, by their names, each with the reason.
        is_rate_assumed: Whether neither the recording nor the user says how many pictures a second there are.
        delay_ns: How much later than it was taken a picture was recorded, mostly, if its time is that of the recording;
            0 where nothing tells.
    """

    camera: str
    height: int
    width: int
    segments: Sequence[Segment]
    hints: Sequence[str] = ()
    told: Sequence[str] = ()
    is_deep: bool = False
    skipped: Sequence[tuple[str, str]] = ()
    is_rate_assumed: bool = False
    delay_ns: int = 0

    def without(self, damaged: Mapping[int, str]) -> Survey:
        """The same recording without some segments, by their numbers, each with the reason."""
        kept = [replace(one, number=number) for number, one in self.numbered if number not in damaged]
        left_out = [(one.name, damaged[number]) for number, one in self.numbered if number in damaged]
        return replace(self, segments=kept, skipped=[*self.skipped, *left_out])

    @property
    def numbered(self) -> list[tuple[int, Segment]]:
        """The segments, each with the number by which ``Recording.pictures`` knows it."""
        return [(place if one.number is None else one.number, one) for place, one in enumerate(self.segments)]

    @property
    def pictures(self) -> int:
        """Of all segments together."""
        return sum(len(segment.times_ns) for segment in self.segments)


class Named(Protocol):
    """A recording as far as a recipe knows it."""

    @property
    def path(self) -> Path:
        """Of it."""

    def sha256(self) -> str:
        """Of its bytes, in hexadecimal."""


class Recording(Protocol):
    """A file or folder of another system, opened for import.

    Attributes:
        path: Of it.
        unreadable: Pictures so far that could not be unpacked, in whose place the ones before them were taken.
    """

    path: Path
    unreadable: int

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Read through it once and check all that can be checked without making frames.

        Args:
            progress: Is told how many pictures were found so far.
        """

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Some frames of a segment.

        Args:
            segment: Its number in the survey.
            wanted: Frame numbers, strictly ascending.
        """

    def sha256(self) -> str:
        """Of its bytes, in hexadecimal."""


def told_of_harm(path: Path, times_ns: Int64[np.ndarray, " n"]) -> str:
    """What is told of a file of which only the beginning is imported.

    Args:
        path: The file.
        times_ns: Of the pictures that stand whole in it.
    """
    lasting = duration(float(times_ns[-1] - times_ns[0]) / 1e9)
    return (
        f"{str(path)!r} is cut off or damaged after {counted(len(times_ns), 'picture')} ({lasting}); what follows is "
        "left out."
    )


def steady_times(count: int, hz: float, path: Path) -> Int64[np.ndarray, " {count}"]:
    """When the pictures of a recording without times were taken: the first at 0 [ns].

    Raises:
        RecordingImportError: The last one would be later than a time can be.
    """
    return _times_at(np.arange(count), hz, path)


def times_after(steps: Int64[np.ndarray, " n"], hz: float, path: Path) -> Int64[np.ndarray, " n+1"]:
    """When the pictures of a recording without times were taken, some of which are missing: the first at 0 [ns].

    Args:
        steps: How many each picture but the first comes after the one before.
        hz: Steps a second.
        path: Of the recording.

    Raises:
        RecordingImportError: The last one would be later than a time can be.
    """
    return _times_at(np.append(0, np.cumsum(steps)), hz, path)


def _times_at(steps: Int64[np.ndarray, " n"], hz: float, path: Path) -> Int64[np.ndarray, " n"]:
    """The times of some steps, ascending [ns]."""
    count = int(steps[-1]) + 1 if len(steps) else 0
    if count * 1e9 / hz >= 2**62:
        raise RecordingImportError(
            f"{str(path)!r} has {count:,} pictures at {hz:g} Hz, more than a century of them; say another rate with "
            "'--source-hz'."
        )
    times: Int64[np.ndarray, " n"] = np.rint(steps * (1e9 / hz)).astype(np.int64)
    return times
