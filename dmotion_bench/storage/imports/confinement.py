"""Recordings that are read in a process apart: what FFmpeg, HDF5 and Arrow make of a hostile file stays there.

Those libraries are written in C and read whatever a file says. In a process of its own, a crash ends that process
and is a sentence here; memory and time have limits that the system keeps; and it can write no file. The process is
started with the first recording that needs it and serves all of an import. ``confined_reader`` is what runs in it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

import numpy as np
from jaxtyping import Int64, UInt8

import dmotion_bench
from dmotion_bench.actions import Continuous, actions_from_json, actions_to_json
from dmotion_bench.errors import RecordingImportError, RecordingNotFetched, RecordingTruncated
from dmotion_bench.gymnasium_ids import CONFINED
from dmotion_bench.storage.imports.commands import Commands, DiscreteCommands
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands
from dmotion_bench.storage.imports.limits import MIB
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Segment, Survey
from dmotion_bench.storage.imports.wire import Hungup, receive, send

READER: Final = (sys.executable, "-B", "-P", "-m", "dmotion_bench.storage.imports.confined_reader")
_KINDS: Final = {kind.__name__: kind for kind in (RecordingImportError, RecordingNotFetched, RecordingTruncated)}


class Confinement:
    """The process, once it is needed; leave the ``with`` block and it is gone.

    Args:
        options: Of the import; the process keeps their limits.
        command: What is started.
    """

    def __init__(self, options: ImportOptions, command: Sequence[str] = READER) -> None:
        self.options, self._command = options, command
        self._process: subprocess.Popen[bytes] | None = None
        self._opened = 0
        self._answered = False

    def open(self, path: Path, kind: str) -> ConfinedRecording:
        """A recording of the kind that ``sources`` calls so.

        Raises:
            RecordingImportError: As the file deserves it.
        """
        number, self._opened = self._opened, self._opened + 1
        self.ask(path, {"do": "open", "number": number, "path": os.fspath(path), "kind": kind})
        return ConfinedRecording(self, number, path)

    def ask(self, path: Path, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Args:
            path: Of the recording that it is about, for the error.
            request: What is asked.

        Raises:
            RecordingImportError: The reader says so, or is gone.
        """
        self.request(path, request)
        return self.answer(path)[0]

    def request(self, path: Path, request: dict[str, Any], body: bytes | memoryview = b"") -> None:
        """Send a request whose answers are fetched one by one.

        Raises:
            RecordingImportError: The reader is gone, or cannot be started here.
        """
        is_new = self._process is None
        if self._process is None:
            self._process, self._answered = self._start(path), False
        try:
            if is_new:
                send(_pipe(self._process.stdin), {"options": dataclasses.asdict(self.options)})
            send(_pipe(self._process.stdin), request, body)
        except OSError:
            raise self._gone(path) from None

    def answer(self, path: Path) -> tuple[dict[str, Any], bytearray]:
        """The next answer.

        Raises:
            RecordingImportError: The reader says so, or is gone.
        """
        assert self._process is not None
        limits = self.options.limits
        most = max(3 * limits.pixels, 16 * (limits.frames + limits.numbers))
        try:
            head, body = receive(_pipe(self._process.stdout), most=most)
        except (Hungup, OSError, ValueError):
            raise self._gone(path) from None
        self._answered = True
        if "error" in head:
            raise _KINDS.get(head["error"], RecordingImportError)(_printable(head["sentence"]))
        if "no_memory" in head:
            raise self._too_large(path)
        return head, body

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._end()
            self._process = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self, path: Path) -> subprocess.Popen[bytes]:
        if importlib.util.find_spec("resource") is None:
            raise RecordingImportError(
                f"{str(path)!r} would be decoded in a process whose memory the system limits, and Windows has no such "
                "limit; import it on Linux or macOS, or in the Windows Subsystem for Linux."
            )
        source = str(Path(dmotion_bench.__file__).parents[1])  # found there even if it was never installed
        paths = [source, *filter(None, [os.environ.get("PYTHONPATH")])]
        own = {"PYTHONPATH": os.pathsep.join(paths), "ARROW_DEFAULT_MEMORY_POOL": "system", CONFINED: "1"}
        return subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # FFmpeg's and its encoders' chatter
            env=os.environ | own,
        )

    def _end(self) -> int:
        """Close the pipes and wait for the process."""
        assert self._process is not None
        with contextlib.suppress(BrokenPipeError):
            _pipe(self._process.stdin).close()
        _pipe(self._process.stdout).close()
        return self._process.wait()

    def _gone(self, path: Path) -> RecordingImportError:
        """Why the process has ended, as an error."""
        code = self._end()
        if code == -signal.SIGPROF:
            seconds = self.options.limits.reader_seconds
            return RecordingImportError(
                f"{str(path)!r} keeps its decoder busy for more than {seconds} s without another picture; it is "
                "damaged, or made to do so."
            )
        if code in (-signal.SIGKILL, -signal.SIGTERM):
            return RecordingImportError(f"reading {str(path)!r} was stopped from outside; the machine may lack memory.")
        how = signal.Signals(-code).name if code < 0 else f"code {code}"
        if code >= 0 and not self._answered:  # whatever goes wrong with a file is an answer
            return RecordingImportError(
                f"the process that was to read {str(path)!r} ended before it read anything ({how}); it may not start "
                f"here, and this command says why: {shlex.join(self._command)} < {os.devnull}"
            )
        return RecordingImportError(f"{str(path)!r} makes its decoder crash ({how}): it is damaged, or made to do so.")

    def _too_large(self, path: Path) -> RecordingImportError:
        most = self.options.limits.reader_bytes // MIB
        return RecordingImportError(
            f"{str(path)!r} takes more than {most:,} MiB of memory to be decoded; if you trust the file, allow more "
            f"with '--max-memory {2 * most}'."
        )


def _printable(sentence: str) -> str:
    """Without what would move a terminal's cursor: a library's words may hold names out of the file."""
    return "".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in sentence)


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    assert pipe is not None
    return pipe


class ConfinedRecording:
    """A recording that another process reads; see ``Recording``."""

    def __init__(self, confinement: Confinement, number: int, path: Path) -> None:
        self._confinement, self._number, self.path, self.unreadable = confinement, number, path, 0

    def sha256(self) -> str:
        """Of its bytes, in hexadecimal."""
        digest: str = self._confinement.ask(self.path, {"do": "sha256", "number": self._number})["sha256"]
        return digest

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Read through it once, over there."""
        self._confinement.request(self.path, {"do": "survey", "number": self._number})
        while True:
            head, body = self._confinement.answer(self.path)
            if "segments" in head:
                break
            progress(int(head["pictures"]))
        self.unreadable = head["unreadable"]
        return unpacked_survey(head, body)

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Some frames of a segment, decoded over there while this process works on those before."""
        request = {"do": "pictures", "number": self._number, "segment": segment}
        self._confinement.request(self.path, request, wanted.astype("<i8").tobytes())
        for _ in range(len(wanted)):
            head, body = self._confinement.answer(self.path)
            self.unreadable = head["unreadable"]
            yield np.frombuffer(body, np.uint8).reshape(head["height"], head["width"], 3)


def packed_survey(survey: Survey) -> tuple[dict[str, Any], bytes]:
    """A survey as a message."""
    segments, arrays = [], []
    for segment in survey.segments:
        arrays.append(segment.times_ns)
        commands, more = (None, []) if segment.commands is None else _packed_commands(segment.commands)
        arrays += more
        facts = {"name": segment.name, "jumps": list(segment.jumps), "source": segment.source}
        segments.append({"count": len(segment.times_ns), "commands": commands, **facts})
    head = {
        "camera": survey.camera,
        "height": survey.height,
        "width": survey.width,
        "segments": segments,
        "hints": list(survey.hints),
        "told": list(survey.told),
        "skipped": list(survey.skipped),
        "is_rate_assumed": survey.is_rate_assumed,
        "delay_ns": survey.delay_ns,
    }
    return head, b"".join(array.astype("<i8").tobytes() for array in arrays)


def _packed_commands(given: Commands) -> tuple[dict[str, Any], list[Int64[np.ndarray, " n"]]]:
    """Their head, and the whole numbers that stand for them; numbers with fractions are sent bit by bit."""
    if isinstance(given, ContinuousCommands):
        head = {
            "count": len(given.values),
            "fields": list(given.names),
            "stated": actions_to_json(given.stated),
            "of_pictures": given.of_pictures,
        }
        return head, [given.times_ns, np.ascontiguousarray(given.values, "<f8").view("<i8").reshape(-1)]
    known = {name: number for number, name in enumerate(dict.fromkeys(given.names))}
    which = np.array([known[name] for name in given.names], np.int64)
    head = {"count": len(given.names), "names": list(known), "vocabulary": list(given.vocabulary)}
    return head, [given.times_ns, which]


def unpacked_survey(head: dict[str, Any], body: bytearray) -> Survey:
    """The survey in a message."""
    numbers, position = np.frombuffer(body, "<i8"), 0

    def array(count: int) -> Int64[np.ndarray, " n"]:
        nonlocal position
        position += count
        return numbers[position - count : position].astype(np.int64)

    segments = []
    for segment in head["segments"]:
        times, given = array(segment["count"]), segment["commands"]
        commands: Commands | None = None
        if given is not None and "fields" in given:
            given_at, width = array(given["count"]), len(given["fields"])
            values = array(given["count"] * width).view(np.float64).reshape(-1, width)
            stated = actions_from_json(given["stated"])
            commands = ContinuousCommands(
                times_ns=given_at,
                values=values,
                names=tuple(given["fields"]),
                stated=stated if isinstance(stated, Continuous) else None,
                of_pictures=given["of_pictures"],
            )
        elif given is not None:
            given_at, which = array(given["count"]), array(given["count"])
            names = [given["names"][number] for number in which.tolist()]
            commands = DiscreteCommands(times_ns=given_at, names=names, vocabulary=given["vocabulary"])
        jumps = [number for number in segment["jumps"] if 0 < number < len(times)]
        name, source = segment["name"], segment["source"]
        segments.append(Segment(times_ns=times, commands=commands, name=name, jumps=jumps, source=source))
    return Survey(
        camera=head["camera"],
        height=head["height"],
        width=head["width"],
        segments=segments,
        hints=head["hints"],
        told=head["told"],
        skipped=[(_printable(name), _printable(why)) for name, why in head["skipped"]],
        is_rate_assumed=head["is_rate_assumed"],
        delay_ns=int(head["delay_ns"]),
    )
