"""A reader of recordings that does what a hostile file can make a decoder do; ``test_confinement`` starts it."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from dmotion_bench.errors import RecordingNotFetched, RecordingTruncated
from dmotion_bench.storage.imports.commands import DiscreteCommands
from dmotion_bench.storage.imports.confined_reader import main
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Segment, Survey


class Misbehaving:
    """What it does is said by the path's name."""

    def __init__(self, path: Path) -> None:
        self.path, self.unreadable = path, 3
        while path.name == "sticky":
            pass

    def sha256(self) -> str:
        os.write(1, b"a library that talks")
        return "ab"

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        match self.path.name:
            case "crash":
                ctypes.string_at(0)
            case "abort":
                os.abort()
            case "hang":
                while True:
                    progress(1)
            case "busy":
                while True:
                    pass
            case "greedy":
                np.ones(1 << 29, np.uint8)
            case "crowded":
                raise ImportError("a.so: failed to map segment from shared object")
            case "writes":
                Path(f"{self.path}.txt").write_text("x" * 100)
            case "truncated":
                raise RecordingTruncated("the end is missing.")
            case "elsewhere":
                raise RecordingNotFetched("it was not fetched.")
            case "surprise":
                raise LookupError("\x1b[31m" + "x" * 1000)
            case "interrupted":
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.05)
        commands = DiscreteCommands(times_ns=np.array([5, 9]), names=["b", "a"], vocabulary=["b", "a", "c"])
        segments = [Segment(times_ns=np.array([3, 7])), Segment(times_ns=np.array([5, 9, 11]), commands=commands)]
        return Survey(camera="eye", height=2, width=3, segments=segments, hints=["look closer."], told=["it blinks."])

    def pictures(self, segment: int, wanted: np.ndarray) -> Iterator[np.ndarray]:
        for number in wanted.tolist():
            if self.path.name == "late" and number == 2:
                os.abort()
            yield np.full((2, 3, 3), 10 * segment + number, np.uint8)


def opened(path: Path, kind: str, options: ImportOptions) -> Misbehaving:
    if path.name == "refused":
        raise RecordingTruncated(f"no {kind} of {options.size} pixels.")
    return Misbehaving(path)


if __name__ == "__main__":
    main(opened)
