"""Entries as files: reading files that are not trusted, and writing many entries in little space.

The figures of the references (copying the last frame, acting at random ...) and the true frames of the pictures are
the same in every entry of a data set. So they stand once in ``references/`` beside the entries, in a file that is named
by its SHA-256, and an entry holds that hash in their place.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.storage.atomic import write_atomically
from leaderboard.entry import HASH, Entry
from leaderboard.layout import REFERENCES

LARGEST: Final = 8 * 2**20
"""Bytes of a file that are read."""
SHARED_FROM: Final = 200
"""Characters from which on what entries share has a file of its own."""
TRUE_FRAMES: Final = ("current", "truth")
"""What of a picture is the same whoever predicts."""


def write_entry(entry: Entry, folder: Path) -> Path:
    """Write an entry in one step under its own name, after the files that it shares with other entries."""
    content = dict(entry.content)
    if entry.is_measured:
        content["reference"] = {name: _share(figures, folder) for name, figures in content["reference"].items()}
        content["pictures"] = [
            picture | {name: _share(picture[name], folder) for name in TRUE_FRAMES} for picture in content["pictures"]
        ]
    path = folder / f"{entry.slug}.json"
    write_atomically(path, (to_lines(content) + "\n").encode())
    return path


def _share(value: Any, folder: Path) -> Any:
    text = to_lines(value) + "\n"
    if len(text) < SHARED_FROM:
        return value
    digest = hashlib.sha256(text.encode()).hexdigest()
    path = folder / REFERENCES / f"{digest}.json"
    if not path.is_file() or path.read_bytes() != text.encode():
        write_atomically(path, text.encode())
    return digest


def read_entry(path: Path) -> Entry:
    """The entry of a file.

    Raises:
        EntryInvalid: There is none, or it is no entry, or references that it names are not beside it; says what.
    """
    try:
        content = _parse(_read(path))
        if isinstance(content, dict) and isinstance(content.get("reference"), dict):
            shared = path.parent / REFERENCES
            content["reference"] = {name: _shared(shared, name, one) for name, one in content["reference"].items()}
            for picture in _pictures(content):
                picture |= {name: _shared(shared, name, picture[name]) for name in TRUE_FRAMES if name in picture}
        return Entry(content)
    except (OSError, ValueError, RecursionError, EntryInvalid) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise EntryInvalid(
            f"{str(path)!r} is no entry of the leaderboard: {said}. "
            "Entries are written by 'dmbench leaderboard build'; what they hold is in leaderboard/schema.json."
        ) from None


def read_entries(folder: Path) -> list[Entry]:
    """Every entry of a folder, in the order of the files' names.

    Raises:
        EntryInvalid: One cannot be read.
    """
    return [read_entry(path) for path in sorted(folder.glob("*.json"))]


def remove_unused_references(folder: Path) -> None:
    """Remove shared files that no entry of a folder names any more."""
    used = {digest for path in folder.glob("*.json") for digest in HASH.findall(path.read_text(errors="replace"))}
    for path in (folder / REFERENCES).glob("*.json"):
        if HASH.fullmatch(path.stem) and path.stem not in used:
            path.unlink()


def _shared(folder: Path, name: str, value: object) -> object:
    """The content that a hash stands for; any other value unchanged."""
    if not isinstance(value, str) or not HASH.fullmatch(value):
        return value
    path = folder / f"{value}.json"
    try:
        raw = _read(path)
    except OSError as error:
        raise ValueError(f"its reference {name!r} stands in {str(path)!r}: {error.strerror}") from None
    if hashlib.sha256(raw).hexdigest() != value:
        raise ValueError(
            f"its reference {name!r} stands in {str(path)!r}, which holds something else than its name says"
        )
    return _parse(raw)


def _pictures(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The pictures in a file that has not been validated yet."""
    pictures = content.get("pictures")
    return [one for one in pictures if isinstance(one, dict)] if isinstance(pictures, list) else []


def _read(path: Path) -> bytes:
    with path.open("rb") as file:
        raw = file.read(LARGEST + 1)
    if len(raw) > LARGEST:
        raise ValueError(f"it is larger than {LARGEST} bytes")
    return raw


def _parse(raw: bytes) -> Any:
    return json.loads(raw, object_pairs_hook=_unique, parse_constant=_no_number, parse_int=_whole, parse_float=_real)


def to_lines(value: Any, indent: str = "") -> str:
    """JSON with one line for each value without nesting; a fifth smaller than one line per number."""
    if not isinstance(value, dict | list) or not any(isinstance(one, dict | list) for one in _values(value)):
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    inner = indent + " "
    if isinstance(value, list):
        return "[\n" + ",\n".join(inner + to_lines(one, inner) for one in value) + f"\n{indent}]"
    named = (f"{inner}{json.dumps(name, ensure_ascii=False)}: {to_lines(one, inner)}" for name, one in value.items())
    return "{\n" + ",\n".join(named) + f"\n{indent}}}"


def _values(value: dict[str, Any] | list[Any]) -> Iterable[Any]:
    return value.values() if isinstance(value, dict) else value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise ValueError("it names something twice")
    return content


def _no_number(text: str) -> Any:
    raise ValueError(f"it holds {text[:20]}, which is no number")


def _whole(text: str) -> int:
    """Parse a whole number; one that floating point cannot hold exactly is refused."""
    return int(text) if len(text) < 16 else _no_number(text)


def _real(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _no_number(text)
