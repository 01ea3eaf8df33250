"""The process that reads a recording for ``confinement``: ``python -m dmotion_bench.storage.imports.confined_reader``.

Before it opens anything it gives up what it does not need: memory beyond the limit, files to write, and more time for
a single picture than any takes. It answers requests from its standard input until that ends.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.confinement import packed_survey
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions, options_from
from dmotion_bench.storage.imports.recording import Recording
from dmotion_bench.storage.imports.wire import Hungup, receive, send

SAY_EVERY_S: Final = 0.2
Open = Callable[[Path, str, ImportOptions], Recording]


class Reader:
    """Answers the requests that arrive through the pipes.

    Args:
        requests, answers: The pipes.
        opened: Opens a recording.
    """

    def __init__(self, requests: IO[bytes], answers: IO[bytes], opened: Open) -> None:
        self._requests, self._answers, self._open = requests, answers, opened
        self._options = options_from(receive(requests, most=0)[0]["options"])
        self._recordings: dict[int, Recording] = {}
        self._said = 0.0

    def serve(self) -> None:
        """Answer requests until the pipe is closed."""
        limits = self._options.limits
        confine(limits)
        while True:
            try:
                request, body = receive(self._requests, most=8 * limits.frames)
            except Hungup:
                return
            try:
                self._answer(request, np.frombuffer(body, "<i8"))
            except MemoryError:
                send(self._answers, {"no_memory": True})
            except RecordingImportError as error:
                if self._lacks_memory():
                    send(self._answers, {"no_memory": True})
                else:
                    send(self._answers, {"error": type(error).__name__, "sentence": str(error)})
            except ImportError as error:
                send(self._answers, {"no_memory": True} if _has_no_room(error) else _told(error))
            except Exception as error:  # whatever a hostile file leads a library to is the file's fault
                send(self._answers, _told(error))

    def _answer(self, request: dict[str, Any], wanted: np.ndarray[Any, Any]) -> None:
        number = request["number"]
        if request["do"] == "sha256":  # takes as long as the file is
            send(self._answers, {"sha256": self._recordings[number].sha256()})
            return
        self._begin_timing()
        try:
            if request["do"] == "open":
                self._recordings[number] = self._open(Path(request["path"]), request["kind"], self._options)
                send(self._answers, {})
            elif request["do"] == "survey":
                self._survey(self._recordings[number])
            else:
                self._send_pictures(self._recordings[number], request["segment"], wanted)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

    def _survey(self, recording: Recording) -> None:
        survey = recording.survey(self._found)
        if survey.skipped and self._lacks_memory():
            raise MemoryError
        head, body = packed_survey(survey)
        send(self._answers, head | {"unreadable": recording.unreadable}, body)

    def _send_pictures(self, recording: Recording, segment: int, wanted: np.ndarray[Any, Any]) -> None:
        for picture in recording.pictures(segment, wanted.astype(np.int64)):
            height, width = picture.shape[:2]
            head = {"height": height, "width": width, "unreadable": recording.unreadable}
            send(self._answers, head, np.ascontiguousarray(picture).data.cast("B"))
            self._begin_timing()

    def _begin_timing(self) -> None:
        """From now on the next picture, or what else was asked for, has its time."""
        signal.setitimer(signal.ITIMER_PROF, self._options.limits.reader_seconds)

    def _lacks_memory(self) -> bool:
        """Whether damage may be a lack of memory: decoders do not tell one from the other."""
        return peak_bytes() > 0.75 * self._options.limits.reader_bytes

    def _found(self, pictures: int) -> None:
        """Tell how far the survey is, now and then; the next picture has its own time."""
        if time.monotonic() - self._said >= SAY_EVERY_S:
            self._begin_timing()
            self._said = time.monotonic()
            send(self._answers, {"pictures": pictures})


def _told(error: Exception) -> dict[str, str]:
    """The answer that tells of an error that nobody expected."""
    sentence = f"the recording cannot be read: {type(error).__name__}: {str(error)[:200]}."
    return {"error": "RecordingImportError", "sentence": sentence}


def _has_no_room(error: ImportError) -> bool:
    """Whether a library could not be loaded for lack of memory, which the system's loader tells in words alone."""
    return any(words in str(error).lower() for words in ("failed to map segment", "cannot allocate memory"))


def peak_bytes() -> int:
    """The most memory that this process has held so far; 0 where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)


def confine(limits: ImportLimits) -> None:
    """Limit what this process can do: memory as far as reading needs it, no file writing, no core dump."""
    import resource  # not on Windows, where confinement starts no reader

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the import, which ends this process
    resource.setrlimit(resource.RLIMIT_DATA, (limits.reader_bytes, limits.reader_bytes))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(opened: Open) -> None:
    """Serve on this process's own pipes; whatever a library prints goes nowhere."""
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        Reader(sys.stdin.buffer, answers, opened).serve()
    except (BrokenPipeError, Hungup):  # the import has ended
        os._exit(0)


if __name__ == "__main__":
    from dmotion_bench.storage.imports.sources import open_here

    main(open_here)
