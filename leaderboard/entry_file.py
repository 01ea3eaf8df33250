"""Entries as files: reading files that are not trusted, and writing many entries in little space.

The figures of the references (copying the last frame, acting at random ...) and the true frames of the pictures are
the same in every entry of a data set. So they stand once in ``references/`` beside the entries, in a file that is named
by its SHA-256, and an entry holds that hash in their place. What a data set's fingerprint is the SHA-256 of, its recipe
and the hashes of its files, stands there, too, where whoever built the leaderboard had the data set.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.sharing.wanted import entry_files
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.json_file import JsonUnreadable, parse_value, read_bounded
from leaderboard.entry import HASH, Entry
from leaderboard.layout import REFERENCES

LARGEST: Final = 8 * 2**20
"""Bytes of an entry that are read, and of all the files that it shares."""
MOST_SHARED: Final = 44
"""Files that an entry may share: the schema has at most 20 references, and 12 pictures with two true frames each."""
MOST_VALUES_SHARED: Final = 20_000
"""Values in one of them: the schema has at most 1,000 figures of five numbers."""
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
        if entry.identity:
            _write_shared(entry.identity, folder)
    path = folder / f"{entry.slug}.json"
    write_atomically(path, (to_lines(content) + "\n").encode())
    return path


def _share(value: Any, folder: Path) -> Any:
    text = to_lines(value) + "\n"
    return value if len(text) < SHARED_FROM else _write_shared(text.encode(), folder)


def _write_shared(content: bytes, folder: Path) -> str:
    """Write a shared file, unless it is there; its SHA-256, which is its name."""
    digest = hashlib.sha256(content).hexdigest()
    path = folder / REFERENCES / f"{digest}.json"
    if not path.is_file() or path.read_bytes() != content:
        write_atomically(path, content)
    return digest


def read_entry(path: Path) -> Entry:
    """The entry of a file.

    Raises:
        EntryInvalid: There is none, or it is no entry, or references that it names are not beside it; says what.
    """
    try:
        content, identity = parse_value(read_bounded(path, largest=LARGEST), exact=True), b""
        if isinstance(content, dict) and isinstance(content.get("reference"), dict):
            shared = _Shared(path.parent / REFERENCES)
            content["reference"] = {name: shared.meant(name, one) for name, one in content["reference"].items()}
            for picture in _pictures(content):
                picture |= {name: shared.meant(name, picture[name]) for name in TRUE_FRAMES if name in picture}
            identity = shared.identity(content.get("dataset"))
        return Entry(content, identity)
    except (OSError, ValueError, EntryInvalid) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise EntryInvalid(
            f"{str(path)!r} is no entry of the leaderboard: {said}. "
            "Entries are written by 'dmbench leaderboard build'; what they hold is in leaderboard/schema.json."
        ) from None


def read_entries(folder: Path) -> list[Entry]:
    """Every entry of a folder (``entry_files``).

    Raises:
        EntryInvalid: One cannot be read.
    """
    return [read_entry(path) for path in entry_files(folder)]


def remove_unused_references(folder: Path) -> None:
    """Remove shared files that no entry of a folder names any more."""
    used = {digest for path in entry_files(folder) for digest in _hashes(path)}
    for path in (folder / REFERENCES).glob("*.json"):
        if HASH.fullmatch(path.stem) and path.stem not in used:
            path.unlink()


def _hashes(path: Path) -> list[str]:
    """What an entry may share; nothing of what is no entry, be it a folder, a pipe or too large."""
    try:
        return HASH.findall(read_bounded(path, largest=LARGEST).decode(errors="replace"))
    except (JsonUnreadable, OSError):
        return []


class _Shared:
    """What one entry shares with others; each file is read once, however often it is named.

    Args:
        folder: Of the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._left = folder, LARGEST
        self._known: dict[str, Any] = {}

    def meant(self, name: str, value: object) -> object:
        """The content that a hash stands for; any other value unchanged.

        Raises:
            ValueError: Its file is not there, or holds something else, or there are too many of them.
        """
        if not isinstance(value, str) or not HASH.fullmatch(value):
            return value
        if value not in self._known:
            if len(self._known) == MOST_SHARED:
                raise ValueError(f"it names more than {MOST_SHARED} references")
            self._known[value] = self._read(name, value)
        return self._known[value]

    def identity(self, dataset: object) -> bytes:
        """What the fingerprint of an entry's data set is the hash of; empty where that is not there.

        Raises:
            ValueError: Its file holds something else, or is too large.
        """
        fingerprint = dataset.get("fingerprint") if isinstance(dataset, dict) else None
        if not isinstance(fingerprint, str) or not HASH.fullmatch(fingerprint):
            return b""  # the schema refuses such an entry
        path = self._folder / f"{fingerprint}.json"
        return self._raw(f"its data set stands in {str(path)!r}", path, fingerprint) if path.is_file() else b""

    def _read(self, name: str, digest: str) -> Any:
        path = self._folder / f"{digest}.json"
        where = f"its reference {name!r} stands in {str(path)!r}"
        raw = self._raw(where, path, digest)
        try:
            return parse_value(raw, most_values=MOST_VALUES_SHARED, exact=True)
        except JsonUnreadable as error:
            raise ValueError(f"{where}: {error}") from None

    def _raw(self, where: str, path: Path, digest: str) -> bytes:
        try:
            raw = read_bounded(path, largest=self._left)
        except OSError as error:
            raise ValueError(f"{where}: {error.strerror}") from None
        except JsonUnreadable as error:
            raise ValueError(f"{where}: {error}") from None
        self._left -= len(raw)
        if hashlib.sha256(raw).hexdigest() != digest:
            raise ValueError(f"{where}, which holds something else than its name says")
        return raw


def _pictures(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The pictures in a file that has not been validated yet."""
    pictures = content.get("pictures")
    return [one for one in pictures if isinstance(one, dict)] if isinstance(pictures, list) else []


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
