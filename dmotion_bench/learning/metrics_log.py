"""``metrics.jsonl``: a training's curves, a JSON object a line, whole again after a kill."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np


class MetricsLog:
    """Where a training's rows go.

    Args:
        file: None where another process writes them.
    """

    def __init__(self, file: IO[str] | None) -> None:
        self._file = file

    @classmethod
    @contextlib.contextmanager
    def resumed(cls, path: Path, step: int) -> Iterator[MetricsLog]:
        """The log opened for appending, without the rows after the step resumed from."""
        rows = path.read_text().splitlines() if path.exists() else []
        kept = [row for row in rows if _step_of(row) <= step]
        with path.open("w", buffering=1) as file:
            file.writelines(f"{row}\n" for row in kept)
            yield cls(file)

    def write(
        self, *, step: int, seconds: float, triplets_per_s: float, learning_rate: float, values: Mapping[str, float]
    ) -> None:
        """Add a row; ``seconds`` are those spent in training steps, over all sittings."""
        if self._file is None:
            return
        row = {
            "step": step,
            "seconds": round(seconds, 3),
            "triplets_per_s": round(triplets_per_s, 1),
            "learning_rate": learning_rate,
            **values,
        }
        self._file.write(json.dumps(row) + "\n")


def _step_of(row: str) -> int:
    """The step of a log's row; a row cut short by a kill counts as one to drop."""
    try:
        return int(json.loads(row)["step"])
    except (json.JSONDecodeError, KeyError, TypeError):
        return np.iinfo(np.int64).max
