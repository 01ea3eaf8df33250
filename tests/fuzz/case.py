"""One case: a number and a seed, from which everything follows, and what came of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from dmotion_bench.errors import DmbenchError

FORMATS = {
    **dict.fromkeys((".mcap", ".zst"), "MCAP"),
    **dict.fromkeys((".json", ".jsonl"), "JSON"),
    **dict.fromkeys((".mp4", ".webm", ".mkv", ".avi"), "video"),
    **dict.fromkeys((".png", ".jpg"), "pictures"),
    ".parquet": "Parquet",
    ".safetensors": "safetensors",
    ".arrow": "Arrow",
    ".hdf5": "HDF5",
}
"""What files are, by the ends of their names."""


class Checksums(StrEnum):
    """Which checksums fit the spoilt bytes."""

    KEPT = "kept"  # none: the damage of a disk
    INNER = "inner"  # those within the file, such as a chunk's CRC-32
    ALL = "all"  # those that other files hold, too: a forger's work


@dataclass
class Case:
    """A case on its way.

    Attributes:
        number, seed: What it is made of.
        target: The name of what is spoilt.
        folder: An empty folder of its own.
        rng: Of its own.
        checksums: Which are made to fit.
        told: What was spoilt, in words.
        formats: The formats of the files that were spoilt.
    """

    number: int
    seed: int
    target: str
    folder: Path
    rng: np.random.Generator = field(init=False)
    checksums: Checksums = field(init=False)
    told: list[str] = field(default_factory=list)
    formats: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, self.number])
        kinds = [Checksums.KEPT, Checksums.INNER, Checksums.ALL]
        self.checksums = kinds[int(self.rng.choice(3, p=[0.4, 0.1, 0.5]))]

    def tell(self, name: str, what: str) -> None:
        """Say what was done to a file, by its name."""
        if Path(name).suffix in FORMATS:
            self.formats.add(FORMATS[Path(name).suffix])
        self.told.append(f"{name}: {what}"[:400])

    def chance(self, share: float) -> bool:
        """Whether something happens that happens so often."""
        return bool(self.rng.random() < share)


@dataclass(frozen=True)
class Answer:
    """What dmbench answered: a value (its digest) or a sentence."""

    value: str | None = None
    sentence: str | None = None


Answers = Mapping[str, Answer]
Ask = Callable[[], Any]


@dataclass(frozen=True)
class Probe:
    """Something that a user does with the spoilt files."""

    name: str
    ask: Ask


class Fault(Exception):
    """Something that must not happen: the kind of it, and what is to be known of it."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(f"{kind}: {detail}")
        self.kind, self.detail = kind, detail


LONGEST_SENTENCE = 4100  # characters; dmbench cuts at 4,000 and says what it left out


def answer_of(ask: Ask) -> Answer:
    """A value or a sentence; whatever else comes out is raised.

    What the operating system refuses is an ``OSError`` in Python, of which the command line makes a sentence.
    """
    try:
        return Answer(value=digest(ask()))
    except DmbenchError as error:
        return Answer(sentence=checked_sentence(str(error)))
    except OSError as error:
        if error.errno is None or error.filename is None:
            raise
        return Answer(sentence=str(error))


def checked_sentence(text: str) -> str:
    """The sentence, if it can be shown to somebody."""
    if not text.strip():
        raise Fault("no sentence", "an error without a word")
    if len(text) > LONGEST_SENTENCE:
        raise Fault("endless sentence", f"{len(text)} characters: {text[:200]!r}")
    if "\x1b" in text:
        raise Fault("control characters", f"{text[:200]!r}")
    return text


def digest(value: Any) -> str:
    """The same for the same content, in few characters."""
    if value is None or (isinstance(value, str | bool | int) and len(str(value)) < 60):
        return repr(value)
    found = hashlib.sha256()
    for piece in _pieces(value):
        found.update(piece)
    return found.hexdigest()[:24]


def _pieces(value: Any) -> Iterable[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, bytes | memoryview):
        yield bytes(value)
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield f"{key!r}:".encode("utf-8", "backslashreplace")
            yield from _pieces(value[key])
    elif isinstance(value, list | tuple):
        yield f"{len(value)}[".encode()
        for one in value:
            yield from _pieces(one)
    elif hasattr(value, "__dataclass_fields__"):
        yield from _pieces({name: getattr(value, name) for name in value.__dataclass_fields__})
    else:
        yield (value if isinstance(value, str) else repr(value)).encode("utf-8", "backslashreplace")


def as_json(value: Any) -> str:
    """Plain values as one line."""
    return json.dumps(value, default=str)
