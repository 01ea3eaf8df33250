"""``metrics.jsonl``: a training's curves, a JSON object a line, whole again after a kill.

A kill or a crash can leave half a row, or bytes that are no text. Such rows are no rows to any reader.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Final

from dmotion_bench.storage.atomic import saying_full, write_atomically
from dmotion_bench.storage.json_file import JsonUnreadable, parse_json

LARGEST: Final = 64 * 2**20  # bytes of a log that are read
_LONGEST: Final = 2**16  # bytes of a row


class MetricsLog:
    """Writes the rows of a training.

    Args:
        file: Open for appending; None where another process writes the rows.
    """

    def __init__(self, file: IO[str] | None) -> None:
        self._file = file

    @classmethod
    @contextlib.contextmanager
    def resumed(cls, path: Path, step: int) -> Iterator[MetricsLog]:
        """The log opened for appending, without the rows after the step resumed from, however long it is.

        Raises:
            StorageFull: There is no space left for it, now or at its end.
        """
        rows = _lines(path, largest=None) if path.is_file() else ()
        kept = [line + b"\n" for line in rows if (row := parse_row(line)) is not None and row[0] <= step]
        write_atomically(path, b"".join(kept))
        file = path.open("a", buffering=1)
        try:
            yield cls(file)
        finally:
            with saying_full(path):
                file.close()

    def write(
        self, *, step: int, seconds: float, triplets_per_s: float, learning_rate: float, values: Mapping[str, float]
    ) -> None:
        """Append a row; ``seconds`` is the time spent in training steps, including earlier sessions.

        Raises:
            StorageFull: There is no space left.
        """
        if self._file is None:
            return
        row = {
            "step": step,
            "seconds": round(seconds, 3),
            "triplets_per_s": round(triplets_per_s, 1),
            "learning_rate": learning_rate,
            **values,
        }
        with saying_full(Path(self._file.name)):
            self._file.write(json.dumps(row) + "\n")


def read_rows(path: Path) -> Iterator[tuple[int, dict[str, float]]]:
    """The rows of a log, in order: the step, and what was written at it. None where there is no log."""
    for line in _lines(path) if path.is_file() else ():
        if (row := parse_row(line)) is not None:
            yield row


def parse_row(line: bytes) -> tuple[int, dict[str, float]] | None:
    """A line of a log as its step and values; None where it is no whole row."""
    try:
        row = parse_json(line, largest=_LONGEST, nan=True)
    except JsonUnreadable:
        return None
    step = row.pop("step", None)
    if type(step) is not int or step < 0:
        return None
    return step, {name: float(value) for name, value in row.items() if type(value) in (int, float)}


def _lines(path: Path, largest: int | None = LARGEST) -> Iterator[bytes]:
    with path.open("rb") as file:
        while (largest is None or file.tell() < largest) and (line := file.readline(_LONGEST)):
            yield line.rstrip(b"\r\n")
